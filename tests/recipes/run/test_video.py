"""Films of test episodes: what is on them, and that the last moment is."""

import sys

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

import nht
import tiny_runs
from nht.envs import make_env
from nht.envs.offscreen import coarse_shadows
from nht.recipes.run.environments import mapped_env
from nht.recipes.run.evaluation import evaluate
from nht.recipes.run.video import (
    COLOURS,
    GAP,
    JERKY,
    MOST_FRAMES,
    SHEET_COLUMNS,
    TILE,
    Film,
    State,
    contact_sheet,
    grid,
    grid_columns,
    record_video,
)
from nht.recipes.sections import EnvConfig

STILL = TensorDictModule(lambda observation: torch.zeros(len(observation), 7), ["observation"], ["action"])
DOWN = TensorDictModule(  # the second joint presses the tool into the table
    lambda observation: torch.eye(7)[1].repeat(len(observation), 1), ["observation"], ["action"]
)
FIRST_DOWN = TensorDictModule(
    lambda observation: torch.eye(7)[1] * torch.eye(len(observation))[0][:, None], ["observation"], ["action"]
)


def wipe(**options):
    config = EnvConfig(context_keys=[], options={"max_episode_steps": 9, **options})
    map = nht.Identity(7)
    map.action_scale.fill_(2.0)
    return mapped_env(config, map, seed=0, num_envs=3)


def tile(value):
    return np.full((4, 6, 3), value, dtype=np.uint8)


def test_a_grid_has_about_as_many_rows_as_columns_and_dark_gaps():
    pictures = [tile(value) for value in range(5)]
    picture = grid(pictures)
    assert picture.shape == (8, 18, 3)
    assert [picture[0, 6 * i, 0] for i in range(3)] == [0, 1, 2]
    assert [picture[4, 6 * i, 0] for i in range(3)] == [3, 4, GAP]
    assert grid([tile(7)]).shape == (4, 6, 3)


@pytest.mark.parametrize(
    ("count", "columns"), [(1, 1), (2, 2), (3, 3), (4, 2), (5, 3), (6, 3), (7, 4), (8, 4), (9, 3), (10, 5)]
)
def test_a_grid_is_nearly_square_and_has_few_gaps(count, columns):
    assert grid_columns(count) == columns


def test_a_contact_sheet_says_how_each_copy_stands_in_its_colour():
    frames = [[np.zeros((80, 240, 3), dtype=np.uint8)] for _ in range(SHEET_COLUMNS)]
    states = [[State(float(moment), "success" if moment > 2 else "")] for moment in range(SHEET_COLUMNS)]
    sheet = contact_sheet(frames, states)
    assert sheet.shape == (40, 120 * SHEET_COLUMNS, 3)
    assert tuple(sheet[20, 0]) == COLOURS[""]
    assert tuple(sheet[20, -1]) == COLOURS["success"]
    assert (sheet[:22, :120] == 255).all(-1).any()  # white letters


def test_a_contact_sheet_goes_from_start_to_end():
    frames = [[tile(moment), tile(100 + moment)] for moment in range(50)]
    sheet = contact_sheet(frames)
    assert sheet.shape == (4, 3 * SHEET_COLUMNS, 3)
    assert (sheet[0, 0, 0], sheet[0, -1, 0], sheet[-1, -1, 0]) == (0, 49, 149)


@pytest.mark.usefixtures("can_render")
def test_films_show_every_copy_to_the_end(tmp_path):
    outcome = record_video(wipe(), DOWN, tmp_path / "film.mp4")
    assert outcome.failure.all()
    video = imageio.imread(tmp_path / "film.mp4")
    width, height = TILE
    assert video.shape[1:] == (height, 3 * width, 3)  # three lie side by side, without a gap
    sheet = imageio.imread(tmp_path / "film.png")
    assert sheet.shape == (3 * height // 2, SHEET_COLUMNS * width // 2, 3)
    assert tuple(sheet[0, 0]) == COLOURS[""]
    assert tuple(sheet[0, -1]) == COLOURS["failed"]


@pytest.mark.usefixtures("can_render")
def test_an_episode_that_has_ended_stands_still():
    env = wipe(terminate_on_failure=True)
    film = Film(env.base_env.task)
    ended = []

    def watch(outcome):
        film.add(outcome)
        ended.append(bool(outcome["done"][0]))

    evaluate(env, FIRST_DOWN, on_step=watch)
    film.close()
    end = film.frames[-1]
    assert ended.index(True) < 8
    assert np.array_equal(end[0], film.frames[-2][0])
    assert not np.array_equal(end[0], film.frames[0][0])
    assert not np.array_equal(end[1], film.frames[-2][1])  # its clock runs on


def test_whoever_watches_sees_the_last_step_and_no_reset():
    env, seen = wipe(), []
    evaluate(
        env, DOWN, on_step=lambda outcome: seen.append((outcome["joint_angle"].clone(), outcome["done"]))
    )
    assert len(seen) == 1 + 9
    assert seen[-1][1].all()
    assert not seen[0][1].any()
    assert (seen[-1][0][:, 1] > seen[0][0][:, 1] + 0.1).all()  # still where the policy brought it


def test_watching_changes_nothing():
    plain = evaluate(wipe(), STILL)
    watched = evaluate(wipe(), STILL, on_step=lambda outcome: None)
    torch.testing.assert_close(plain.episode_return, watched.episode_return)


class Drawn:
    """Copies of which every picture is blank; drawing them is counted."""

    num_envs, observation_sizes = 2, ()

    def __init__(self, steps, time_per_step):
        self.max_episode_steps, self.time_per_step, self.drawn = steps, time_per_step, 0

    def renderer(self, width, height):
        return self

    def frame(self, row, trail):
        self.drawn += 1
        return np.zeros((24, 32, 3), dtype=np.uint8)


def filmed(steps, time_per_step):
    task = Drawn(steps, time_per_step)
    film = Film(task)
    for step in range(steps + 1):
        flag = torch.full((2, 1), step == steps)
        film.add(TensorDict({"done": flag, "success": ~flag & flag, "failure": ~flag & flag}, batch_size=2))
    return film, task


@pytest.mark.parametrize(
    ("steps", "time_per_step", "speed"),
    [(1_000, 0.05, 4), (1_000, 0.01, 1), (200, 0.04, 1), (100, 0.5, 1), (10_000, 0.05, 38)],
)
def test_films_of_long_episodes_are_short(steps, time_per_step, speed):
    film, task = filmed(steps, time_per_step)
    assert film.speed == speed
    assert len(film.frames) <= MOST_FRAMES + 1  # the end is always filmed
    assert task.drawn <= 2 * (MOST_FRAMES + 1)
    assert film.frames_per_second >= min(JERKY, 1 / time_per_step)
    seconds = steps * time_per_step / speed
    assert len(film.frames) / film.frames_per_second == pytest.approx(seconds, rel=0.03)


@pytest.mark.usefixtures("can_render")
def test_coarse_shadows_leave_the_model_and_other_renderers_alone():
    task = wipe().base_env.task
    quality, screen = task.model.vis.quality, task.model.vis.global_
    before = quality.shadowsize, screen.offwidth, screen.offheight
    plain = task.renderer(64, 48)
    with coarse_shadows(16):
        coarse = task.renderer(64, 48)
        assert (quality.shadowsize, screen.offwidth, screen.offheight) == before
    again = task.renderer(64, 48)
    pictures = [renderer.frame(0) for renderer in (plain, coarse, again)]
    np.testing.assert_array_equal(pictures[0], pictures[2])
    differing = (pictures[0] != pictures[1]).any(-1).mean()
    assert 0 < differing < 0.1  # nothing but the edges of shadows
    for renderer in (plain, coarse, again):
        renderer.close()


@pytest.mark.usefixtures("can_render")
def test_a_picture_may_be_larger_than_the_models_own_buffer():
    task = make_env("half_cheetah", seed=0).task
    assert task.model.vis.global_.offwidth < 800
    renderer = task.renderer(800, 600)
    assert renderer.frame(0).shape == (600, 800, 3)
    renderer.close()


def test_without_the_package_that_draws_it_a_task_is_trained_and_not_filmed(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pygame", None)
    told = ["env=gymnasium", "env.name=Pendulum-v1", "map.action_scale=2", "evaluation.video=true"]
    told = [*told, "algo.total_frames=200", "evaluation.every=200"]
    metrics = tiny_runs.train("ppo", tmp_path / "run", *told)
    assert metrics["frames"].tolist() == [200]
    said = capsys.readouterr().out
    assert "no video: the environment cannot be drawn: pygame is not installed" in said
    assert "gymnasium[classic" in said
    assert not (tmp_path / "run" / "video.mp4").exists()
    assert (tmp_path / "run" / "whole.json").exists()
