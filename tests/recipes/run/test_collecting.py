"""Parallel collectors: workers get the policy's weights and their own seeds, and leave nothing behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pandas
import pytest
import torch

import nht.recipes.ppo
import tiny_runs
from nht.recipes.agents.ppo import estimate_advantages
from nht.recipes.config import DDPG
from nht.recipes.launch import configure
from nht.recipes.run.collecting import worker_seed
from nht.recipes.run.record import Record
from nht.recipes.run.workers import WorkerEndedError, Workers
from nht.recipes.sections import CollectorConfig

SETTINGS = ["algo.total_frames=400", "evaluation.every=400"]


def train(algorithm, kind, folder, *overrides):
    return tiny_runs.train(algorithm, folder, *SETTINGS, f"collector={kind}", *overrides)


def assert_nothing_runs():
    assert not multiprocessing.active_children()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", tiny_runs.RECIPES)
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
def test_workers_make_exactly_as_many_steps(algorithm, kind, tmp_path, monkeypatch):
    batches = []
    count = Record.count_steps
    monkeypatch.setattr(
        Record, "count_steps", lambda run, data: (batches.append(data.clone()), count(run, data))
    )
    metrics = train(algorithm, kind, tmp_path / "run")
    assert metrics["frames"].tolist() == [400]
    copies = {"multi_sync": 4, "multi_async": 2}[kind]
    assert [tuple(batch.shape) for batch in batches] == 4 * [(copies, 100 // copies)]
    if kind == "multi_sync":  # each worker draws its own goals and noise
        first = batches[0]
        assert not torch.equal(first["observation"][:2, 0], first["observation"][2:, 0])
        assert not torch.equal(first["action"][:2], first["action"][2:])
    assert_nothing_runs()


@pytest.mark.slow
def test_synchronous_workers_repeat_a_run(tmp_path):
    first = train("ddpg", "multi_sync", tmp_path / "first", "algo.random_frames=200")
    again = train("ddpg", "multi_sync", tmp_path / "again", "algo.random_frames=200")
    other = train("ddpg", "multi_sync", tmp_path / "other", "algo.random_frames=200", "seed=1")
    pandas.testing.assert_frame_equal(first, again)
    assert not first.equals(other)


@pytest.mark.slow
def test_workers_act_by_the_policy_as_it_is(tmp_path, monkeypatch):
    seen = []

    def compare(data, features, critic, gae):
        now = features(data.select("observation").clone())
        seen.append((float(features.module.count), now["features"], data["features"].clone()))
        estimate_advantages(data, features, critic, gae)

    monkeypatch.setattr(nht.recipes.ppo, "estimate_advantages", compare)
    train("ppo", "multi_sync", tmp_path / "run")
    assert [count for count, _, _ in seen] == [0, 100, 200, 300]
    for _, now, then in seen:
        torch.testing.assert_close(now, then)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_no_worker_outlives_an_error(kind, error, tmp_path, monkeypatch):
    workers = []

    def fail(run, _):
        workers.extend(multiprocessing.active_children())
        raise error

    monkeypatch.setattr(Record, "count_steps", fail)
    with pytest.raises(error):
        train("ddpg", kind, tmp_path / "run")
    assert len(workers) >= 2
    assert_nothing_runs()
    for worker in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(worker.pid, 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
def test_a_run_with_workers_goes_on(kind, tmp_path):
    train("ddpg", kind, tmp_path / "run", "evaluation.every=200")
    metrics = train(
        "ddpg", kind, tmp_path / "run", "evaluation.every=200", "algo.total_frames=800", "run.resume=true"
    )
    assert metrics["frames"].tolist() == [200, 400, 600, 800]
    assert metrics["updates"].tolist() == [6, 12, 18, 24]
    with pytest.raises(ValueError, match=r"holds a run with collector\.kind=multi_.*sync"):
        train("ddpg", "single", tmp_path / "run", "algo.total_frames=1000", "run.resume=true")


def workers_of(process):
    """The processes that step a collector's copies, by their numbers."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def kill_a_worker(process, workers):
    os.kill(workers[-1], signal.SIGKILL)


def tell_all_to_end(process, workers):
    os.killpg(process.pid, signal.SIGTERM)


def kill_the_parent(process, workers):
    process.kill()


def runs(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
@pytest.mark.parametrize(
    ("attack", "code", "words"),
    [
        (kill_a_worker, 1, r"error: collector: worker 1 was killed by SIGKILL. Go on with run.resume=auto."),
        (tell_all_to_end, 128 + signal.SIGTERM, "was told to end: go on with run.resume=true."),
        (kill_the_parent, -signal.SIGKILL, ""),
    ],
)
def test_attacked_a_run_with_workers_ends(kind, attack, code, words, tmp_path):
    folder = tmp_path / "run"
    told = tiny_runs.settings("ddpg", folder, "algo.total_frames=1000000", f"collector={kind}")
    command = [sys.executable, "-m", "nht.recipes.ddpg", *told]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        wait_for(lambda: list(folder.glob("checkpoints/checkpoint-*")), process)
        workers = workers_of(process)
        frames = latest_checkpoint(folder)
        attack(process, workers)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert words in output + errors
    assert sum(line.startswith("error:") for line in errors.splitlines()) == (code == 1)
    if code > 0:
        assert latest_checkpoint(folder) >= frames
    wait_until(lambda: not any(map(runs, workers)))
    assert len(workers) == 2


def latest_checkpoint(folder):
    return max(int(path.stem.split("-")[1]) for path in folder.glob("checkpoints/checkpoint-*"))


def wait_until(condition):
    until = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def wait_for(condition, process):
    until = time.monotonic() + 200
    while not condition():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < until
        time.sleep(0.05)


class DeafCollector:
    """Whose worker is a process that sleeps, and which waits for it to acknowledge weights, as TorchRL does."""

    def __init__(self, worker):
        self.procs = [worker]

    def __iter__(self):
        yield "batch"
        raise OSError("a pipe of TorchRL's has broken")

    def update_policy_weights_(self, policy):
        threading.Event().wait()


@pytest.fixture
def sleeping():
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(1000,))
    worker.start()
    yield worker
    worker.kill()
    worker.join()


def test_a_workers_death_is_noticed_wherever_torchrl_waits(sleeping):
    workers = Workers(DeafCollector(sleeping), torch.device("cpu"))
    assert workers.next() == "batch"
    threading.Timer(0.5, sleeping.kill).start()
    with pytest.raises(WorkerEndedError, match=r"^collector: worker 0 was killed by SIGKILL\.$"):
        workers.update(None)


def test_the_reason_of_a_broken_pipe_is_told(sleeping):
    workers = Workers(DeafCollector(sleeping), torch.device("cpu"))
    assert workers.next() == "batch"
    threading.Timer(0.5, sleeping.kill).start()
    with pytest.raises(WorkerEndedError, match="was killed by SIGKILL"):
        workers.next()


def test_errors_that_have_nothing_to_do_with_death_are_passed_on(sleeping):
    workers = Workers(DeafCollector(sleeping), torch.device("cpu"))
    workers.next()
    with pytest.raises(OSError, match="a pipe of TorchRL's has broken"):
        workers.next()


def test_seeds_of_workers_differ_and_repeat():
    seeds = {worker_seed(seed, rank, worker) for seed in range(3) for rank in range(3) for worker in range(3)}
    assert len(seeds) == 27
    assert worker_seed(1, 2) == worker_seed(1, 2)


def test_errors():
    with pytest.raises(
        ValueError, match=r"collector\.kind must be single, multi_sync or multi_async, got 'ray'"
    ):
        CollectorConfig(kind="ray")
    with pytest.raises(ValueError, match=r"collector\.num_workers must be at least 1, got 0"):
        CollectorConfig(kind="multi_sync", num_workers=0)
    with pytest.raises(ValueError, match=r"collector=single has no workers, got collector\.num_workers=2"):
        CollectorConfig(num_workers=2)
    with pytest.raises(ValueError, match=r"env\.num_envs=4 must be a multiple of collector\.num_workers=3"):
        configure(DDPG, "ddpg", ["env.num_envs=4", "collector=multi_sync", "collector.num_workers=3"])
