"""A search that is killed, or whose workers are, goes on by the same command: every run as if nothing had happened.

The environment variable ``NHT_KILLED_RUNS`` says how many searches; ``NHT_KILLED_RUNS_FIRST``, from which draw on;
``NHT_KILLS``, a file for a row of each kill.
"""

import json
import os
import random
import time

import pandas
import pytest

import killed_searches
from kill_table import newest, noted

RUNS = int(os.environ.get("NHT_KILLED_RUNS", "1"))
FIRST = int(os.environ.get("NHT_KILLED_RUNS_FIRST", "0"))
BASE = [
    "env.num_envs=4",
    "env.options.max_episode_steps=25",
    "algo.frames_per_batch=100",
    "algo.hidden=[16,16]",
    "algo.updates_per_batch=3",
    "algo.warmup_frames=0",
    "evaluation.every=400",
    "evaluation.episodes=2",
    "evaluation.video=false",
    "run.checkpoint_every=200",
    "run.wandb=false",
    "map.max_steps=100",
]
SETTINGS = [
    "search=smoke",
    "search.interfaces=[nht,raw]",
    "search.configs=1",
    "search.best_seeds=0",
    "search.total_frames=1200",
    f"search.base={BASE}",
    "demos.transitions=500",
]

KINDS = {"search": [], "search in packs": ["search.seeds=2", "search.learners=2"]}
KILLED = {"search": "its process", "worker": "Ray's workers"}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def whole(kind, tmp_path_factory):
    """A search that nothing disturbed, when its first run began, and when it ended, in seconds after its start."""
    told = [*SETTINGS, *KINDS[kind]]
    folder = tmp_path_factory.mktemp("whole") / "search"
    killed_searches.finish(folder.with_name("first"), told)  # loads what others find loaded
    start = time.time()
    seconds = killed_searches.finish(folder, told)
    return folder, min(file.stat().st_mtime for file in folder.rglob("config.yaml")) - start, seconds


@pytest.mark.slow
@pytest.mark.timeout(900)  # starts Ray up to four times
@pytest.mark.parametrize("number", range(FIRST, FIRST + RUNS))
def test_a_killed_search_is_mended_by_the_same_command(kind, whole, number, tmp_path):
    undisturbed, begins, seconds = whole
    told = [*SETTINGS, *KINDS[kind]]
    draw, folder = random.Random(f"{kind} {number}"), tmp_path / "search"
    attacks = []
    for _ in range(draw.randint(1, 3)):
        victim = draw.choice(["search", "worker"])
        training = victim == "worker" or draw.random() < 0.5  # workers have nothing to do before
        attacks.append((draw.uniform(0, seconds - begins if training else begins), victim, training))
    with noted(kind, number, seconds) as kills:
        for at, victim, training in attacks:
            if killed_searches.kill_after(at, victim, folder, told, training):
                kills.append((KILLED[victim], at + begins * training, newest(folder)))
        killed_searches.finish(folder, told)
        assert_same(folder, undisturbed)


def assert_same(folder, undisturbed):
    rows = [rows_of(path) for path in (folder, undisturbed)]
    pandas.testing.assert_frame_equal(*rows)
    assert set(rows[0]["status"]) == {"done"}
    for run in undisturbed.glob("search/*/*"):
        mended = folder / run.relative_to(undisturbed)
        for name in ("map.safetensors", "policy.safetensors", "whole.json"):
            assert (mended / name).read_bytes() == (run / name).read_bytes(), mended / name
        outcomes = [json.loads((path / "outcome.json").read_text()) for path in (mended, run)]
        assert outcomes[0] | {"core_seconds": 0} == outcomes[1] | {"core_seconds": 0}
    assert names(folder) == names(undisturbed)  # nothing is left lying about


def rows_of(folder):
    return pandas.read_csv(folder / "rows.csv", keep_default_na=False).drop(
        columns=["seconds", "core_seconds"]
    )


def names(folder):
    """All but what runs have said, which they say where they are trained: beside others, or alone."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "train.log")
    return sorted(str(path.relative_to(folder)) for path in files)
