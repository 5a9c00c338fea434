"""Films on the way: when they are made, and that training does not notice."""

import random

import numpy as np
import pandas
import pytest
import torch

import tiny_runs
import wandb_file
from nht.recipes.config import DDPG
from nht.recipes.launch import configure
from nht.recipes.run import filming
from nht.recipes.run.evaluation import evaluate

SHORT = ["algo.total_frames=400", "evaluation.every=100"]
ON_THE_WAY = [*SHORT, "evaluation.video_every=200"]


@pytest.fixture
def filmed(monkeypatch):
    """What has been filmed: by somebody who runs the policy and draws from all generators."""
    paths = []

    def film(env, policy, path):
        paths.append(path)
        outcome = evaluate(env, policy)
        torch.rand(7), np.random.rand(3), random.random()  # noqa: NPY002
        torch.manual_seed(9)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"a film")
        return outcome

    monkeypatch.setattr(filming, "record_video", film)
    return paths


@pytest.mark.parametrize("algorithm", ["ddpg", "ppo"])
def test_training_does_not_notice(filmed, tmp_path, algorithm):
    plain = tiny_runs.train(algorithm, tmp_path / "plain", *SHORT)
    assert not filmed
    watched = tiny_runs.train(algorithm, tmp_path / "watched", *ON_THE_WAY)
    assert [path.relative_to(tmp_path / "watched").as_posix() for path in filmed] == [
        "films/000000000200.mp4"
    ]  # the end would be the run's own film, which is not asked for
    pandas.testing.assert_frame_equal(plain, watched)
    weights = [(tmp_path / name / "policy.safetensors").read_bytes() for name in ("plain", "watched")]
    assert weights[0] == weights[1]


def test_every_learner_of_a_population_is_filmed(filmed, tmp_path):
    plain = tiny_runs.start("ddpg", tmp_path / "plain", *SHORT, "seeds=2")
    tiny_runs.start("ddpg", tmp_path / "watched", *ON_THE_WAY, "seeds=2")
    assert plain is None
    assert [path.parts[-3:] for path in filmed] == [
        (f"seed-{seed}", "films", "000000000200.mp4") for seed in (0, 1)
    ]
    for seed in ("seed-0", "seed-1"):
        one, other = (
            pandas.read_csv(tmp_path / name / seed / "metrics.csv") for name in ("plain", "watched")
        )
        pandas.testing.assert_frame_equal(one.drop(columns="seconds"), other.drop(columns="seconds"))


def test_films_stand_beside_the_row_of_their_test(filmed, tmp_path):
    tiny_runs.start("ddpg", tmp_path / "run", *ON_THE_WAY, "evaluation.video=true", "run.wandb=true")
    found = wandb_file.read_run(tmp_path / "run")
    films = found.column("eval/film")
    assert list(films) == [200, 400]
    assert films.keys() < found.column("eval/return").keys()
    assert all(film["_type"] == "video-file" for film in films.values())


def test_a_machine_without_opengl_says_so_once_and_trains(tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise RuntimeError("offscreen rendering needs OpenGL: install EGL.")

    monkeypatch.setattr(filming, "record_video", refuse)
    metrics = tiny_runs.train("ddpg", tmp_path / "run", *SHORT, "evaluation.video_every=100")
    assert len(metrics) == 4
    assert capsys.readouterr().out.count("no video: offscreen rendering needs OpenGL") == 1


def test_films_come_at_evaluations(tmp_path):
    with pytest.raises(
        ValueError, match=r"evaluation\.video_every must be a multiple of evaluation\.every=200"
    ):
        configure(
            DDPG,
            "ddpg",
            tiny_runs.settings("ddpg", tmp_path, "evaluation.every=200", "evaluation.video_every=300"),
        )
