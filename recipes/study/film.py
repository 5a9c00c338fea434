"""A film of the best policy of each interface, side by side: all start from the same posture, to the same goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import pandas

from nht.recipes.agents.policy import POLICY_FILE, load_policy
from nht.recipes.run.environments import TEST_SEED, lasting_failures, mapped_env
from nht.recipes.run.evaluation import evaluate
from nht.recipes.run.metrics import FRAMES, tested
from nht.recipes.run.saved_run import kept_map, read_config
from nht.recipes.run.video import Film, Picture, State, contact_sheet, write_film


def best_runs(curves: pandas.DataFrame, folders: Sequence[Path], metric: str, lines: str) -> dict[str, Path]:
    """The folder of the finished run whose last evaluation is best, for each interface or algorithm.

    Args:
        curves: evaluations of runs, with the number of the folder of each in the column ``run``.
        folders: of the runs.
        metric: what is best.
        lines: ``interface`` or ``algorithm``.
    """
    last = curves.sort_values(FRAMES).groupby("run").tail(1)
    done = last[[(folders[run] / POLICY_FILE).exists() for run in last["run"]]]
    best = done.sort_values(tested(metric), kind="stable").groupby(lines, sort=False).tail(1)
    found = {str(name): folders[run] for name, run in zip(best[lines], best["run"], strict=True)}
    return {str(name): found[str(name)] for name in curves[lines].unique() if str(name) in found}


def film_runs(runs: dict[str, Path], path: Path) -> None:
    """Film an episode of the policy of each run, and write MP4 and contact sheet.

    Args:
        runs: folders, by the name to write into the picture.
        path: of the MP4.

    Raises:
        RuntimeError: if this machine cannot render offscreen, or the task cannot be drawn.
        ValueError: if a run cannot be read, or names code of other packages.
    """
    films = [_film_run(name, folder) for name, folder in runs.items()]
    frames, states = side_by_side(films)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_film(path, frames, min(film.frames_per_second for film in films))
    imageio.imwrite(path.with_suffix(".png"), contact_sheet(frames, states))


def _film_run(name: str, folder: Path) -> Film:
    config = read_config(folder)
    env = lasting_failures(config.env)
    env = replace(env, num_envs=1, num_threads=1)
    shown = mapped_env(env, kept_map(folder, config), seed=TEST_SEED, num_envs=1)
    film = Film(shown.base_env.task, name)
    try:
        evaluate(shown, load_policy(folder, shown, config), on_step=film.add)
    finally:
        film.close()
        shown.close()
    return film


def side_by_side(films: Sequence[Film]) -> tuple[list[list[Picture]], list[list[State]]]:
    """The moments of several films together; one that is shorter stands still at its end."""
    length = max(len(film.frames) for film in films)
    moments = [[min(moment, len(film.frames) - 1) for film in films] for moment in range(length)]
    frames = [
        [film.frames[place][0] for film, place in zip(films, places, strict=True)] for places in moments
    ]
    states = [
        [film.states[place][0] for film, place in zip(films, places, strict=True)] for places in moments
    ]
    return frames, states
