"""Two ranks: whichever is killed, or their launcher, at any time, the same command mends the run, bit for bit.

``NHT_KILLED_RUNS``, ``NHT_KILLED_RUNS_FIRST`` and ``NHT_KILLS`` in the environment are as for ``test_kills.py``.
"""

import os
import random
import re

import pandas
import pytest

import killed_ranks
from kill_table import newest, noted
from nht.recipes.data.recording import record_expert
from nht.recipes.sections import DemosConfig, EnvConfig

RUNS = int(os.environ.get("NHT_KILLED_RUNS", "2"))
FIRST = int(os.environ.get("NHT_KILLED_RUNS_FIRST", "0"))
SETTINGS = ["algo.total_frames=600", "evaluation.every=200", "map=nht", "map.max_steps=100", "map.hidden=[8]"]


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
    killed_ranks.finish(request.param, folder.with_name("first"), told)
    return request.param, told, folder, killed_ranks.finish(request.param, folder, told)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(FIRST, FIRST + RUNS))
def test_a_run_of_two_is_mended_by_the_same_command(whole, number, tmp_path):
    algorithm, told, undisturbed, seconds = whole
    draw, folder = random.Random(f"ranks {algorithm} {number}"), tmp_path / "run"
    attacks = [
        (draw.uniform(0, seconds), draw.choice(["launcher", 0, 1]), draw.randint(0, 1))
        for _ in range(draw.randint(1, 3))
    ]
    with noted(f"{algorithm}, two ranks", number, seconds) as kills:
        for time, victim, restarts in attacks:
            if killed_ranks.kill_after(time, victim, algorithm, folder, told, restarts):
                who = victim if victim == "launcher" else f"rank {victim}"
                kills.append((who, time, newest(folder)))
        killed_ranks.finish(algorithm, folder, told)
        metrics = [
            pandas.read_csv(path / "metrics.csv").drop(columns="seconds") for path in (folder, undisturbed)
        ]
        pandas.testing.assert_frame_equal(*metrics)
        for name in ("map.safetensors", "policy.safetensors", "whole.json"):
            assert (folder / name).read_bytes() == (undisturbed / name).read_bytes(), name
        assert names(folder) == names(undisturbed)  # nothing is left lying about


def names(folder):
    """Of its files; ranks that were told to end have written a checkpoint then, after other steps than usual."""
    files = (str(path.relative_to(folder)) for path in folder.rglob("*"))
    return sorted(re.sub(r"checkpoint-\d+", "checkpoint", name) for name in files)
