"""What the version before wrote still means what it meant: `tests/support/old_run`, a run of 400 steps and its map.

It was made by `ddpg env=wam_wipe map=nht map.action_scale=0.7`, small, when a run's configuration had the scale of the
actions and its map had none of its own. What the old version then did with it is written down here.
"""

import shutil
from pathlib import Path

import pandas
import pytest
import torch

import nht
import tiny_runs
from nht.recipes import evaluate
from nht.recipes.config import Evaluate
from nht.recipes.launch import configure
from nht.recipes.run.saved_run import kept_map, read_config

OLD = Path(tiny_runs.__file__).with_name("old_run")
SETTINGS = ["map=nht", "map.hidden=[8]", "map.max_steps=250", "demos.transitions=1000", "algo.hidden=[8,8]"]
SETTINGS += ["algo.buffer_size=400", "evaluation.every=200", "map.action_scale=0.7"]
NEXT_ROW = {"train_failure": 0.375, "loss_actor": 39.807461420694985, "loss_value": 2.632453501224518}
"""Of the old version's evaluation after 600 steps."""


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(OLD, tmp_path / "run")
    return tmp_path / "run"


def test_an_old_map_file_is_read_as_it_was():
    map = nht.load_map(OLD / "map.safetensors")
    assert (map.saturation, map.offset, map.context_keys) == (
        "clip",
        "none",
        ("tool_position", "joint_angle"),
    )
    action, context = torch.tensor([[0.5, -2.0]]), torch.linspace(-1, 1, 10)[None]
    assert torch.equal(map.rest(context), torch.zeros(1, 7))
    low, high = torch.full((7,), -0.1), torch.full((7,), 0.1)
    expected = map(map.action_scale * action, context).clamp(low, high)
    assert torch.equal(map.decode(action, context, low, high), expected)


def test_the_scale_of_an_old_run_is_that_of_its_configuration(folder):
    config = read_config(folder)
    assert type(config).__name__ == "DDPG"
    assert config.map.action_scale == 0.7
    assert float(kept_map(folder, config).action_scale) == pytest.approx(0.7)
    assert float(nht.load_map(folder / "map.safetensors").action_scale) != pytest.approx(0.7)


def test_an_old_run_is_evaluated(folder, capsys):
    evaluate.main(configure(Evaluate, "evaluate", [f"run={folder}", "episodes=5", "video=false"]))
    assert capsys.readouterr().out.split() == [
        *("eval_success", "0.000"),
        *("eval_failure", "0.000"),
        *("eval_return", "-25.000"),
    ]


def test_an_old_run_goes_on_as_it_would_have(folder):
    more = ["algo.total_frames=600", "run.resume=true"]
    rows = tiny_runs.train("ddpg", folder, *SETTINGS, *more)
    assert rows["frames"].tolist() == [200, 400, 600]
    pandas.testing.assert_frame_equal(rows[:2], pandas.read_csv(OLD / "metrics.csv").drop(columns="seconds"))
    assert {name: rows[name].iloc[-1] for name in NEXT_ROW} == NEXT_ROW


def test_an_old_run_cannot_become_another_one(folder):
    for override, message in (
        ("map.action_scale=0.1", r"map\.action_scale=0\.7: it cannot go on with map\.action_scale=0\.1"),
        ("map.lipschitz=3", r"map\.lipschitz=None: it cannot go on with map\.lipschitz=3"),
        ("algo.actor_learning_rate=0.1", r"algo\.actor_learning_rate=0\.001: it cannot go on with"),
        ("seed=1", r"seed=0: it cannot go on with seed=1"),
    ):
        with pytest.raises(ValueError, match=message):
            tiny_runs.train("ddpg", folder, *SETTINGS, "algo.total_frames=600", "run.resume=true", override)
