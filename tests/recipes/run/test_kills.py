"""Killed at any time, once or several times, a run is mended by the same command, and ends as if nothing had happened.

The number of runs for each algorithm is in the environment variable ``NHT_KILLED_RUNS``.
"""

import os
import random

import pandas
import pytest

import killed_runs
from nht.recipes.data.recording import record_expert
from nht.recipes.sections import DemosConfig, EnvConfig

RUNS = int(os.environ.get("NHT_KILLED_RUNS", "3"))
FIRST = int(os.environ.get("NHT_KILLED_RUNS_FIRST", "0"))
SETTINGS = [
    "algo.total_frames=600",
    "evaluation.every=300",
    "evaluation.video=true",
    "map=nht",
    "map.max_steps=100",
    "map.hidden=[8]",
]


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos") / "demos"
    record_expert(EnvConfig(name="wam_wipe"), DemosConfig(transitions=500), 5, folder)
    return folder


@pytest.fixture(scope="module", params=["ddpg", "ppo"])
def whole(request, demos, tmp_path_factory):
    """The algorithm, what it is told, a run that nothing disturbed, and its duration in seconds."""
    folder = tmp_path_factory.mktemp(request.param) / "whole"
    told = [*SETTINGS, f"demos.path={demos}"]
    killed_runs.finish(
        request.param, folder.with_name("first"), told
    )  # the first one loads what others find loaded
    return request.param, told, folder, killed_runs.finish(request.param, folder, told)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(FIRST, FIRST + RUNS))
def test_a_killed_run_is_mended_by_the_same_command(whole, number, tmp_path, record_property):
    algorithm, told, undisturbed, seconds = whole
    draw, folder = random.Random(f"{algorithm} {number}"), tmp_path / "run"
    times = [draw.uniform(0, seconds) for _ in range(draw.randint(1, 4))]
    kills = [killed_runs.kill_after(time, algorithm, folder, told) for time in times]
    record_property("kills", sum(kills))
    print(f"{algorithm} {number}: killed after {times} s of {seconds:.1f} s: {kills}")
    killed_runs.finish(algorithm, folder, told)
    assert_same(folder, undisturbed)
    before = contents(folder)
    killed_runs.finish(algorithm, folder, told)  # whole, it has nothing left to do
    assert contents(folder) == before


def assert_same(folder, other):
    metrics = [pandas.read_csv(path / "metrics.csv").drop(columns="seconds") for path in (folder, other)]
    pandas.testing.assert_frame_equal(*metrics)
    for name in ("map.safetensors", "policy.safetensors", "whole.json"):
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name
    assert (folder / "video.mp4").stat().st_size > 0
    assert names(folder) == names(other)  # nothing is left lying about


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
