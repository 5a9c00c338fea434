"""Several learners under torchrun: two equal one, and a run outlives the death of one of them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas
import pytest
import torch
import yaml

import failing_ranks
import tiny_runs
import two_ranks
from nht.recipes.run.ranks import Ranks

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]


def command(algorithm, folder, *overrides, launcher=()):
    told = tiny_runs.settings(algorithm, folder, "evaluation.every=200", *overrides)
    return [*TORCHRUN, *launcher, "-m", f"nht.recipes.{algorithm}", *told]


def run(*arguments, **options):
    return subprocess.run(command(*arguments, **options), capture_output=True, text=True, timeout=200)


@pytest.fixture(scope="module")
def trained_by_two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    process = subprocess.run(
        [*TORCHRUN, two_ranks.__file__, folder], capture_output=True, text=True, timeout=100
    )
    assert process.returncode == 0, process.stderr
    return folder


@pytest.mark.parametrize("algorithm", tiny_runs.RECIPES)
def test_two_ranks_with_half_the_batch_equal_one_with_the_whole(trained_by_two, algorithm):
    alone = two_ranks.update(algorithm, Ranks())
    untrained = [
        value for network in two_ranks.networks(algorithm) for value in network.state_dict().values()
    ]
    for rank in (0, 1):
        together = torch.load(trained_by_two / f"{algorithm}-{rank}.pt")
        for one, two in zip(alone, together, strict=True):
            torch.testing.assert_close(two, one, rtol=0, atol=1e-6)
    assert sum(torch.equal(old, new) for old in untrained for new in alone if old.shape == new.shape) == 0


def test_two_ranks_start_from_demonstrations_as_one_does(trained_by_two):
    alone = two_ranks.start(Ranks())
    together = [torch.load(trained_by_two / f"start-{rank}.pt") for rank in (0, 1)]
    for one, *two in zip(alone, *together, strict=True):
        assert two[0].equal(two[1])
        torch.testing.assert_close(two[0], one, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", tiny_runs.RECIPES)
def test_a_recipe_with_two_ranks(algorithm, tmp_path):
    process = run(algorithm, tmp_path / "run", "algo.total_frames=400")
    assert process.returncode == 0, process.stderr
    metrics = pandas.read_csv(tmp_path / "run" / "metrics.csv")
    assert metrics["frames"].tolist() == [200, 400]  # of both together
    assert process.stdout.count("policy.safetensors") == 1
    assert {path.name for path in (tmp_path / "run" / "checkpoints").iterdir()} == {"rank-0", "rank-1"}
    more = run(algorithm, tmp_path / "run", "algo.total_frames=600", "run.resume=true")
    assert more.returncode == 0, more.stderr
    assert pandas.read_csv(tmp_path / "run" / "metrics.csv")["frames"].tolist() == [200, 400, 600]
    alone = command(algorithm, tmp_path / "run", "algo.total_frames=800", "run.resume=true")
    one = subprocess.run(
        [sys.executable, *alone[len(TORCHRUN) :]], capture_output=True, text=True, timeout=100
    )
    assert "holds the checkpoints of 2 processes: 1 cannot go on from them" in one.stderr


@pytest.mark.slow
def test_a_rank_that_dies_is_started_again(tmp_path):
    folder = tmp_path / "run"
    arguments = command("ddpg", folder, "algo.total_frames=6000", launcher=["--max-restarts=1"])
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: list(folder.glob("checkpoints/rank-1/checkpoint-*")), process)
        os.kill(int(ranks_of(process)[1]), signal.SIGKILL)
        _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    metrics = pandas.read_csv(folder / "metrics.csv")
    assert metrics["frames"].tolist() == list(range(200, 6001, 200))
    assert metrics["updates"].tolist() == list(range(6, 181, 6))
    assert yaml.safe_load((folder / "config.yaml").read_text())["run"]["resume"] is False


def wait_for(condition, process):
    until = time.monotonic() + 100
    while not condition():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < until
        time.sleep(0.05)


def ranks_of(process):
    """The processes that torchrun started, by rank."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ranks = {}
    for child in children:
        entries = Path(f"/proc/{child}/environ").read_bytes().split(b"\0")
        variables = dict(entry.split(b"=", 1) for entry in entries if b"=" in entry)
        if b"RANK" in variables:
            ranks[int(variables[b"RANK"])] = child
    return ranks


@pytest.mark.slow
@pytest.mark.parametrize("attack", ["kill the launcher", "tell all to end"])
def test_ranks_end_with_their_launcher_after_a_last_checkpoint(attack, tmp_path):
    folder = tmp_path / "run"
    with subprocess.Popen(
        command("ddpg", folder, "algo.total_frames=1000000"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        wait_for(lambda: list(folder.glob("checkpoints/rank-1/checkpoint-*")), process)
        ranks = ranks_of(process)
        if attack == "kill the launcher":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGTERM)
        output, errors = process.communicate(timeout=60)  # to the end of the last one that can write there
    assert len(ranks) == 2
    assert "was told to end: go on with run.resume=true." in output, errors
    for number in ranks.values():
        assert not Path(f"/proc/{number}").exists() or " Z " in Path(f"/proc/{number}/stat").read_text()
    latest = [
        max(path.name for path in folder.glob(f"checkpoints/rank-{rank}/checkpoint-*")) for rank in (0, 1)
    ]
    assert latest[0] == latest[1]
    steps = int(latest[0].split("-")[1].split(".")[0]) // 200 * 200 + 200
    more = run("ddpg", folder, f"algo.total_frames={steps}", "run.resume=true")
    assert more.returncode == 0, more.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("failing", "heard"), [("0 1", 0), ("1", 1)])
def test_an_error_is_said_once(failing, heard):
    process = subprocess.run(
        [*TORCHRUN, failing_ranks.__file__],
        capture_output=True,
        text=True,
        timeout=200,
        env=os.environ | {"FAILING": failing},
    )
    assert process.returncode != 0
    said = [line for line in process.stderr.splitlines() if line.startswith("error: ")]
    assert said == [f"error: rank {heard} has no luck."]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.num_envs=5", "env.num_envs=5 must be a multiple of the 2 processes that share it"),
        ("algo.batch_size=3", "algo.batch_size=3 must be a multiple of the 2 processes that share it"),
    ],
)
def test_what_two_ranks_cannot_share(override, message, tmp_path):
    process = run("ddpg", tmp_path / "run", "algo.total_frames=400", override)
    assert process.returncode != 0
    assert message in process.stderr


def test_one_process_shares_nothing():
    ranks = Ranks()
    values = torch.arange(3.0)
    assert ranks.first
    assert ranks.restarts == 0
    assert ranks.size == 1
    assert ranks.share("env.num_envs", 7) == 7
    assert ranks.sum(values) is values
    assert ranks.any(True)
    assert not ranks.any(False)
    assert ranks.gather([1, 2]) == [[1, 2]]
