"""Killed at any time, once or several times, a run is mended by the same command, and ends as if nothing had happened.

The environment variable ``NHT_KILLED_RUNS`` says how many runs of each kind; ``NHT_KILLED_RUNS_FIRST``, from which draw
on; ``NHT_KILLS``, a file for a row of each kill.
"""

import json
import os
import random

import pandas
import pytest

import killed_runs
from kill_table import newest, noted

RUNS = int(os.environ.get("NHT_KILLED_RUNS", "2"))
FIRST = int(os.environ.get("NHT_KILLED_RUNS_FIRST", "0"))
SHARED = ["algo.total_frames=600", "evaluation.every=300"]
MAP = ["map=nht", "map.max_steps=100", "map.hidden=[8]", "demos.transitions=500"]
FILM = ["evaluation.video=true", "env.options.max_episode_steps=5"]

KINDS = {
    "alone": ([], None, None),
    "making its map": (MAP, "config.yaml", "map.safetensors"),
    "filming": (FILM, "policy.safetensors", "whole.json"),
    "population": ([*MAP, "seeds=3"], None, None),
}
"""What a run is told, and between which two of its files it is killed: None is its start, and its end."""


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module", params=["ddpg", "ppo"])
def whole(request, kind, tmp_path_factory):
    """The algorithm, what it is told, a run that nothing disturbed, and the seconds that it can be killed in."""
    folder, (told, since, until) = tmp_path_factory.mktemp(request.param) / "whole", KINDS[kind]
    told = [*SHARED, *told]
    killed_runs.finish(request.param, folder.with_name("first"), told)  # loads what others find loaded
    seconds = killed_runs.finish(request.param, folder, told)
    if since is not None:
        seconds = (killed_runs.written(folder, until) - killed_runs.written(folder, since)) / 1e9
    return request.param, told, folder, seconds


@pytest.mark.slow
@pytest.mark.parametrize("number", range(FIRST, FIRST + RUNS))
def test_a_killed_run_is_mended_by_the_same_command(whole, kind, number, tmp_path):
    algorithm, told, undisturbed, seconds = whole
    since = KINDS[kind][1]
    draw, folder = random.Random(f"{kind} {algorithm} {number}"), tmp_path / "run"
    with noted(f"{algorithm}, {kind}", number, seconds) as kills:
        for time in [draw.uniform(0, seconds) for _ in range(draw.randint(1, 4))]:
            if killed_runs.kill_after(time, algorithm, folder, told, since):
                kills.append(("its process", time, newest(folder)))
        killed_runs.finish(algorithm, folder, told)
        assert_same(folder, undisturbed)
        assert {path.name for path in tmp_path.iterdir()} <= {"run", "run.log", "torchinductor_root"}
    before = contents(folder)
    killed_runs.finish(algorithm, folder, told)  # whole, it has nothing left to do
    assert contents(folder) == before


def assert_same(folder, other):
    """Nothing differs but what says when it was and how long it took, and nothing is left lying about."""
    found, wanted = contents(folder), contents(other)
    assert sorted(found) == sorted(wanted)
    for name in wanted:
        if name.endswith("metrics.csv"):
            tables = [pandas.read_csv(path / name).drop(columns="seconds") for path in (folder, other)]
            pandas.testing.assert_frame_equal(*tables)
        elif name.endswith("map.json"):
            assert json.loads(found[name]) | {"seconds": 0} == json.loads(wanted[name]) | {"seconds": 0}
        elif name.endswith((".safetensors", "whole.json", ".png", ".mp4")):
            assert found[name] == wanted[name], name


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
