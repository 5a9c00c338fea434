"""Recipes as the pages start them: composed as on the command line, or run with budgets of a second."""

from __future__ import annotations

import importlib
import runpy
import shutil
import sys
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import nht
import nht.recipes.launch as launching
from nht.recipes.sections import Training

TRAINING = [
    "env.num_envs=4",
    "algo.total_frames=200",
    "algo.frames_per_batch=100",
    "evaluation.every=200",
    "evaluation.episodes=2",
    "evaluation.video=false",
    "run.checkpoint_every=200",
    "algo.hidden=[16]",
    "map.hidden=[16]",
    "map.max_steps=20",
    "demos.transitions=300",
]
REPLAY = ["algo.updates_per_batch=2", "algo.warmup_frames=0", "algo.buffer_size=1000"]
BUDGETS = {
    "ddpg": [*TRAINING, *REPLAY],
    "held_ddpg": [*TRAINING, *REPLAY],
    "ppo": [*TRAINING, "algo.minibatches=5", "algo.epochs=1"],
    "sac": [*TRAINING, *REPLAY, "algo.random_frames=100"],
    "td3": [*TRAINING, *REPLAY, "algo.random_frames=100"],
    "collect_demos": ["demos.transitions=300"],
    "train_map": ["demos.transitions=300", "map.max_steps=20", "map.hidden=[16]"],
    "compare_maps": ["map.max_steps=20", "map.hidden=[16]"],
    "evaluate": ["episodes=2", "video_episodes=1", "env_options={max_episode_steps: 3}"],
}
"""What makes each recipe short, in place of the page's own settings of these names."""
SHORTER = {"algo.demos.transitions": "100", "seeds": "2", "action_dims": "[2]"}
"""Settings that stay where a page has them, with other values."""


Main = Callable[[Any], object]


class Composed(Exception):  # noqa: N818 - no error: what a recipe would have been called with
    """Ends a recipe where its work would begin."""


def compose(module: str, words: list[str]) -> object:
    """The configuration that a command line makes; nothing is run.

    Raises:
        SystemExit: if the recipe refuses it, with the line that its user sees.
    """

    def keep(config: object) -> None:
        raise Composed(config)

    try:
        _start(module, words, lambda _: keep)
    except Composed as composed:
        return composed.args[0]
    raise AssertionError(f"{module} did not start.")


def run(module: str, words: list[str]) -> None:
    """Run a recipe in this process, in the current folder, with a budget of a second, over what is there."""
    name = module.rpartition(".")[2]
    budget = BUDGETS.get(name, [])
    short = {word.partition("=")[0] for word in budget}
    kept = []
    for word in words:
        key, _, value = word.partition("=")
        if key not in short or value == "true":
            kept.append(f"{key}={SHORTER[key]}" if key in SHORTER else word)
    given = {word.partition("=")[0] for word in kept}
    words = [*kept, *(word for word in budget if word.partition("=")[0] not in given)]

    def over_what_is_there(main: Main) -> Main:
        def clear_and_run(config: Any) -> object:
            folder = config.run.folder if isinstance(config, Training) else None
            for place in (folder, getattr(config, "out", None)):
                if place and name not in ("report", "export_map", "inspect_demos"):
                    shutil.rmtree(place, ignore_errors=True)
                    Path(place).unlink(missing_ok=True)
            return main(config)

        return clear_and_run

    _start(module, words, over_what_is_there)


def prepare(outside: Path) -> None:
    """Put what the pages take for granted into the current folder: demonstrations, a map, data sets, and a package."""
    sys.path.insert(0, str(outside))
    (Path("my_package")).mkdir()
    Path("my_package/__init__.py").touch()
    Path("my_package/robots.py").write_text(
        "from torchrl.envs import GymEnv\n\n\ndef make():\n    return GymEnv('Pendulum-v1')\n"
    )
    sys.path.insert(0, str(Path.cwd()))
    run("nht.recipes.collect_demos", ["out=runs/demos"])
    run("nht.recipes.collect_demos", ["env=wam_grasp", "out=runs/grasp-demos"])
    run("nht.recipes.collect_demos", ["env=six_joints.reach:REACH", "out=runs/reach-demos"])
    run("nht.recipes.train_map", ["demos.path=runs/demos", "out=runs/nht.safetensors"])
    run("nht.recipes.ddpg", ["map.file=runs/nht.safetensors"])
    for copy in ("shared/demos", "runs/by-hand-wam_wipe"):
        shutil.copytree("runs/demos", copy)
    Path("runs/search-wam_wipe").mkdir()
    for name in ("rows.csv", "manifest.json"):
        shutil.copy(f"benchmarks/results/search_wam_wipe/{name}", f"runs/search-wam_wipe/{name}")
    nht.to_minari(nht.load_demos("runs/demos"), "wam/wipe-v0")
    with h5py.File("hopper.hdf5", "w") as file:
        file["observations"] = np.zeros((40, 11), np.float32)
        file["actions"] = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
        file["rewards"] = np.ones(40, np.float32)
        file["terminals"] = np.arange(40) % 20 == 19


def _start(module: str, words: list[str], changed: Callable[[Main], Main] = lambda main: main) -> None:
    """Start a recipe as the command line does, with another main function."""
    kept = sys.modules.pop(module, None)  # else runpy warns that it is there already
    launch = launching.launch
    try:
        with _arguments([module, *words]), pytest.MonkeyPatch.context() as patch:
            patch.setattr(launching, "launch", lambda main, *how, **more: launch(changed(main), *how, **more))
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        if kept is not None:
            sys.modules[module] = kept


@contextmanager
def _arguments(words):
    kept = sys.argv
    sys.argv = words
    try:
        yield
    finally:
        sys.argv = kept
        importlib.invalidate_caches()
