"""Runs of a search: claimed once, recorded however they end, and gone on with."""

import os
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pandas
import pytest
from ray import exceptions as ray_errors

from nht.recipes import search
from nht.recipes.agents.table import Algorithm
from nht.recipes.config import Search, SearchConfig
from nht.recipes.launch import configure
from nht.recipes.run.ownership import claimed
from nht.recipes.run.workers import WorkerEndedError
from nht.recipes.study import cluster as cluster_module
from nht.recipes.study import plan
from nht.recipes.study.jobs import TRIES, Ending, Job, rows_of, run_job

BASE = [
    "evaluation.every=200",
    "evaluation.episodes=2",
    "evaluation.video=false",
    "run.wandb=false",
    "run.checkpoint_every=200",
    "env.options.max_episode_steps=25",
    "algo.updates_per_batch=1",
    "algo.warmup_frames=0",
]
SMOKE = [
    "search=smoke",
    "search.interfaces=[svd,raw]",
    "search.configs=1",
    "search.total_frames=400",
    "search.best_frames=400",
    f"search.base={BASE}",
    "demos.transitions=500",
]


class InProcess:
    """A cluster of this process alone."""

    def __init__(self, *_):
        self.done = []

    def run(self, work, jobs, folder):
        for job in jobs:
            work(job, folder)
            self.done.append(job.name)
            yield job

    def close(self):
        pass


@pytest.fixture
def cluster(monkeypatch):
    cluster = InProcess()
    monkeypatch.setattr(cluster_module, "Cluster", lambda *_: cluster)
    return cluster


@pytest.fixture
def recipe(monkeypatch):
    """A recipe that notes what it is told, and does as ``recipe.act`` says."""
    told = SimpleNamespace(configs=[], act=lambda config: None)

    def train(_, config):
        told.configs.append(config)
        told.act(config)

    monkeypatch.setattr(Algorithm, "train", train)
    return told


def job(number=0, **changes):
    entries = {
        "stage": "search",
        "env": "wam_wipe",
        "interface": "raw",
        "configuration": number,
        "seed": 0,
        "recipe": "ddpg",
        "metric": "success",
        "parameters": {"algo.gamma": 0.95},
        "overrides": ("map=none", "algo.gamma=0.95"),
    }
    return Job(**entries | changes)


def run_search(folder, *overrides):
    search.main(configure(Search, "search", [*SMOKE, f"folder={folder}", *overrides]))
    return pandas.read_csv(folder / "rows.csv", keep_default_na=False)


def test_a_search_from_start_to_end(cluster, tmp_path, capsys):
    rows = run_search(tmp_path / "search")
    assert set(rows["status"]) == {"done"}
    runs = rows.groupby(["stage", "interface", "configuration", "seed"])["frames"].apply(list)
    assert set(runs.index) == {
        ("search", "svd", 0, 0),
        ("search", "raw", 0, 0),
        ("best", "svd", 0, 100),
        ("best", "raw", 0, 100),
    }
    assert all(frames == [200, 400] for frames in runs)
    assert "python -m nht.recipes.report" in capsys.readouterr().out
    log = (tmp_path / "search" / "search" / "svd" / "000-seed0" / "train.log").read_text()
    assert log.startswith("python -m nht.recipes.ddpg env=wam_wipe map=svd map.action_dim=2 demos.path=")
    assert not list((tmp_path / "search").rglob("checkpoints"))
    # Again: nothing is left to do. Then more of the same.
    count = len(cluster.done)
    pandas.testing.assert_frame_equal(run_search(tmp_path / "search"), rows)
    assert len(cluster.done) == count
    # On another machine, with nothing but the manifest and the rows.
    for name in ("manifest.json", "rows.csv"):
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        shutil.copy(tmp_path / "search" / name, tmp_path / "elsewhere" / name)
    pandas.testing.assert_frame_equal(run_search(tmp_path / "elsewhere"), rows)
    assert len(cluster.done) == count
    more = run_search(tmp_path / "search", "search.seeds=2")
    assert len(cluster.done) == count + 2
    assert more[(more["stage"] == "search") & (more["seed"] == 0)]["eval_return"].tolist() == (
        rows[rows["stage"] == "search"]["eval_return"].tolist()
    )
    with pytest.raises(ValueError, match=r"is of another search: total_frames was 400, is 600"):
        run_search(tmp_path / "search", "search.total_frames=600", "search.seeds=2")


def test_failures_are_recorded_and_do_not_stop_the_others(cluster, recipe, tmp_path):
    def act(config):
        if config.map.kind == "svd":
            raise FloatingPointError("loss_value is nan")
        if config.seed == 1:
            raise RuntimeError("out of\n luck")

    recipe.act = act
    folder = tmp_path / "search"
    rows = run_search(folder, "search.seeds=2", "search.best_seeds=0")
    found = {(row.interface, row.seed): (row.status, row.reason) for row in rows.itertuples()}
    assert found == {
        ("svd", 0): ("diverged", "FloatingPointError: loss_value is nan"),
        ("svd", 1): ("diverged", "FloatingPointError: loss_value is nan"),
        ("raw", 0): ("done", ""),
        ("raw", 1): ("failed", "RuntimeError: out of luck"),
    }
    tried = len(recipe.configs)
    run_search(folder, "search.seeds=2", "search.best_seeds=0")
    assert len(recipe.configs) == tried
    recipe.act = lambda config: None
    rows = run_search(folder, "search.seeds=2", "search.best_seeds=0", "retry_failed=true")
    assert len(recipe.configs) == tried + 3
    assert set(rows["status"]) == {"done"}


def test_a_run_is_what_a_person_would_type(recipe, tmp_path):
    config = configure(Search, "search", ["search=wam", "search.base=['algo=ddpg']"]).search
    nht, raw = (plan.make_job(config, "demos", "search", name, 3, 1, 200_000) for name in ("nht", "raw"))
    for one in (nht, raw):
        assert run_job(one, tmp_path) == Ending("done")
    learned, plain = recipe.configs
    assert (learned.map.kind, plain.map.kind) == ("nht", "none")
    layers, units = nht.parameters["map.hidden_layers"], nht.parameters["map.hidden_units"]
    assert learned.map.hidden == layers * [units]
    assert learned.map.lipschitz == pytest.approx(nht.parameters["map.lipschitz"])
    assert learned.algo == plain.algo
    assert learned.algo.polyak == pytest.approx(raw.parameters["algo.polyak"])
    assert learned.seed == 1
    assert learned.run.resume == "auto"
    assert learned.run.wandb_job_type == "nht"
    assert learned.algo.total_frames == 200_000


def test_an_interrupted_run_has_not_ended(recipe, tmp_path):
    def interrupt(config):
        raise KeyboardInterrupt

    recipe.act = interrupt
    with pytest.raises(KeyboardInterrupt):
        run_job(job(), tmp_path)
    assert Ending.read(tmp_path / job().name) is None
    recipe.act = lambda config: None
    assert run_job(job(), tmp_path) == Ending("done")
    assert rows_of(job(), tmp_path)[["status", "algo.gamma"]].to_numpy().tolist() == [["done", 0.95]]


def test_nobody_runs_what_another_one_is_at(recipe, tmp_path):
    recipe.act = lambda config: outcomes.append(run_job(job(), tmp_path))
    outcomes = []
    assert run_job(job(), tmp_path) == Ending("done")
    assert outcomes == [None]
    assert len(recipe.configs) == 1


def test_a_run_whose_workers_died_is_tried_again(recipe, tmp_path):
    def die_once(config):
        if len(recipe.configs) == 1:
            raise WorkerEndedError("collector: worker 0 was killed by SIGKILL.")

    recipe.act = die_once
    assert run_job(job(), tmp_path) == Ending("done")
    assert len(recipe.configs) == 2
    assert recipe.configs[0] == recipe.configs[1]  # from its last checkpoint, by run.resume=auto
    said = (tmp_path / job().name / "train.log").read_text()
    assert "worker 0 was killed by SIGKILL. Tried again, 2 times at most." in said


def test_a_run_whose_workers_always_die_fails_at_last(recipe, tmp_path):
    def die(config):
        raise WorkerEndedError("collector: worker 0 was killed by SIGKILL.")

    recipe.act = die
    ending = Ending("failed", "WorkerEndedError: collector: worker 0 was killed by SIGKILL.")
    assert run_job(job(), tmp_path) == ending
    assert len(recipe.configs) == TRIES


def test_a_run_that_a_person_has_started_is_waited_for(tmp_path):
    run = tmp_path / job().name
    with claimed(run / ".owner"):
        assert run_job(job(), tmp_path) is None
        assert "is being written by process" in (run / "train.log").read_text()
    assert Ending.read(run) is None
    assert not list((tmp_path / "claims").iterdir())  # free for whoever comes next


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "search.interfaces=[nht,pca]",
            r"unknown search\.interfaces 'pca': choose from \['raw', 'nht', ",
        ),
        ("search.interfaces=[]", r"search\.interfaces is empty"),
        ("search.base=['algo.gama=0.9']", r"gama"),
        (
            "+search.space.raw={algo.gamma: {normal: [0, 1]}}",
            r"search\.space\.raw\.algo\.gamma must be one of",
        ),
        ("ray_address=127.0.0.1:9", r"no Ray cluster answers at ray_address=127\.0\.0\.1:9"),
        ("ray_address=nonsense", r"no Ray cluster answers at ray_address=nonsense"),
    ],
)
def test_mistakes_are_told_before_anything_runs(override, message, tmp_path):
    with pytest.raises((ValueError, ConnectionError), match=message):
        run_search(tmp_path / "search", "demos.path=nowhere", override)
    assert not list(tmp_path.rglob("train.log"))


def test_the_jacobian_needs_an_arm():
    config = configure(Search, "search", ["search=half_cheetah", "search.interfaces=[jacobian]"])
    with pytest.raises(
        ValueError, match=r"jacobian needs an arm: \['wam_grasp', 'wam_wipe'\] have one, 'half_ch"
    ):
        search.main(config)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("configs", 0, r"search\.configs must be at least 1, got 0"),
        ("seeds", -1, r"search\.seeds must be at least 1, got -1"),
        ("best_seeds", -1, r"search\.best_seeds must not be negative"),
        ("metric", "loss", r"search\.metric must be success or return, got 'loss'"),
        ("recipe", "reinforce", r"unknown algorithm 'reinforce': choose from \['ddpg', 'ppo'"),
    ],
)
def test_settings_out_of_range(field, value, message):
    with pytest.raises(ValueError, match=message):
        SearchConfig(**{field: value})


@pytest.mark.slow
def test_on_ray_stopped_and_gone_on(tmp_path):
    folder = tmp_path / "search"
    command = [sys.executable, "-m", "nht.recipes.search", *SMOKE, "search.configs=2", f"folder={folder}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        until = time.monotonic() + 200
        while not list(folder.glob("search/*/*/outcome.json")):
            assert process.poll() is None, process.stdout.read()
            assert time.monotonic() < until
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode != 0
    kept = {path: path.stat().st_mtime_ns for path in folder.glob("search/*/*/outcome.json")}
    again = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert again.returncode == 0, again.stderr
    assert {path: path.stat().st_mtime_ns for path in kept} == kept  # what was finished stays
    rows = pandas.read_csv(folder / "rows.csv", keep_default_na=False)
    assert set(rows["status"]) == {"done"}
    assert len(rows[["stage", "interface", "configuration", "seed"]].drop_duplicates()) == 6


def fake_ray(error):
    """As much of Ray as a cluster's ``run`` asks for; every job raises ``error``."""

    def get(_):
        raise error

    def remote(**_):
        return lambda work: SimpleNamespace(remote=lambda job, folder: job.name)

    nodes = [{"Resources": {"CPU": 1.0}}, {"Resources": {}}]
    return SimpleNamespace(
        remote=remote, wait=lambda waiting, num_returns: (waiting[:1], []), get=get, nodes=lambda: nodes
    )


def run_on(monkeypatch, error, folder):
    monkeypatch.setattr(cluster_module, "ray", fake_ray(error))
    cluster = object.__new__(cluster_module.Cluster)  # Ray is not started
    cluster._tasks_per_gpu = 1
    return list(cluster.run(run_job, [job()], folder))


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ray_errors.LocalRayletDiedError(), "LocalRayletDiedError: The task's local raylet died"),
        (ray_errors.NodeDiedError("gone"), "NodeDiedError: gone"),
        (ray_errors.RayTaskError("run_job", "a traceback", OSError("no room")), "OSError: no room"),
    ],
)
def test_what_is_no_fault_of_a_run_is_not_recorded_as_one(error, reason, monkeypatch, tmp_path):
    told = rf"the run search/raw/000-seed0 is not finished: {reason}.*\. Start the same command again"
    with pytest.raises(RuntimeError, match=told):
        run_on(monkeypatch, error, tmp_path)
    assert Ending.read(tmp_path / job().name) is None


def test_a_job_whose_worker_always_dies_fails_unless_it_had_ended(monkeypatch, tmp_path):
    error = ray_errors.WorkerCrashedError()
    assert run_on(monkeypatch, error, tmp_path) == [job()]
    found = Ending.read(tmp_path / job().name)
    assert found.status == "failed"
    assert found.reason.startswith("WorkerCrashedError: The worker died unexpectedly")
    Ending("done").write(tmp_path / job().name)
    run_on(monkeypatch, error, tmp_path)
    assert Ending.read(tmp_path / job().name) == Ending("done")


@pytest.mark.parametrize(
    ("overrides", "needed"),
    [
        ([], (1, 0)),
        (["env.num_threads=3"], (3, 0)),
        (["env.num_threads=3", "env.num_threads=64"], (8, 0)),
        (["device=cuda", "env.num_threads=2"], (2, 0.25)),
        (["device=cuda:1"], (1, 0.25)),
        (["device=cuda", "device=cpu"], (1, 0)),
    ],
)
def test_what_a_task_needs(overrides, needed):
    assert cluster_module.resources(overrides, tasks_per_gpu=4, most_cpus=8) == needed


@pytest.mark.slow
def test_machines_without_the_package_or_with_another_one(monkeypatch):
    monkeypatch.setattr(cluster_module, "version", lambda _: "9.9")
    with pytest.raises(ImportError, match=r"has nht .*, this machine has 9\.9: install the same there"):
        cluster_module.Cluster(num_workers=1)
    assert not cluster_module.ray.is_initialized()


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(tmp_path):
    """The worker is killed once its first checkpoint is there; another one goes on from it."""
    folder = tmp_path / "search"
    config = configure(Search, "search", [*SMOKE, "search.interfaces=[raw]", "search.total_frames=4000"])
    (run,) = plan.search_jobs(config.search, tmp_path)
    cluster = cluster_module.Cluster(num_workers=1)
    try:
        finished = cluster.run(killed_once, [run], folder)
        assert [one.name for one in finished] == [run.name]
    finally:
        cluster.close()
    assert Ending.read(folder / run.name) == Ending("done")
    assert len((folder / "deaths").read_text()) == 1
    assert rows_of(run, folder)["frames"].tolist() == list(range(200, 4001, 200))


def killed_once(run, folder):
    """Train, and the first time be killed after 1,000 steps."""
    from nht.recipes.run.record import Record

    count, deaths = Record.count_steps, folder / "deaths"

    def die(self, data):
        count(self, data)
        if self.frames == 1_000 and not deaths.exists():
            deaths.write_text("x")
            os.kill(os.getpid(), signal.SIGKILL)

    Record.count_steps = die
    return run_job(run, folder)
