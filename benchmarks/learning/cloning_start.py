"""What a cloning start does for PPO, which replays no demonstrations, and for TD3 and SAC, which replay them, too.

PPO on both arm tasks, through NHT and with raw joints, five seeds; TD3 and SAC on WAMGrasp through NHT, three seeds,
with a quarter of each minibatch demonstrated. In all of them the actor starts from 2,000 gradient steps of behaviour
cloning on 10,000 demonstrated steps, or as it is made. DDPG's start is in ``imitation.py``.

In the folder of ``demos_in_replay.py``, with its demonstrations and maps. Writes rows, a table and a figure of each
task to ``results/cloning_start``.

    python benchmarks/learning/cloning_start.py FOLDER [TASK ...]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import demos_in_replay
import ingredients
import pandas

from nht.recipes.figure_style import GREEN, PURPLE
from nht.recipes.study.figures import colour
from populations import plot, save, trained_runs

OUT = Path(__file__).parents[1] / "results" / "cloning_start"
DEMOS = f"algo.demos.transitions={demos_in_replay.DEMOS}"
START = [DEMOS, "algo.demos.cloning_start=2_000"]
PPO = [
    "algo.hidden=[128,128]",
    "algo.total_frames=409_600",
    "evaluation.episodes=50",
    "evaluation.every=40_960",
    "run.checkpoint_every=40_960",
]
COLOURS = {"PPO, nht": colour("nht"), "PPO, raw": colour("raw"), "TD3, nht": PURPLE, "SAC, nht": GREEN}
STYLES = {"": ":", ", start": "-"}
LOOKS = {f"{who}{way}": (shade, style) for who, shade in COLOURS.items() for way, style in STYLES.items()}


class Variant(NamedTuple):
    """A learner, its way of acting, and what it is told."""

    name: str
    algorithm: str
    map: str
    told: Sequence[str]
    seeds: Sequence[int]


def variants(task: str) -> Iterator[Variant]:
    """All of a task, without and with the start."""
    for map in ("nht", "raw"):
        for way, start in (("", []), (", start", START)):
            yield Variant(f"PPO, {map}{way}", "ppo", map, [*PPO, *start], range(5))
    if task != "wam_grasp":
        return
    _, told, _, others, noise = ingredients.TASKS[task]
    quarter = demos_in_replay.WAYS["a quarter"]
    for algorithm, explores in (("td3", noise), ("sac", [])):
        for way, start in (("", []), (", start", START)):
            settings = [*told, *others, *explores, *quarter, *start]
            yield Variant(f"{algorithm.upper()}, nht{way}", algorithm, "nht", settings, range(3))


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    for task in sys.argv[2:] or demos_in_replay.TASKS:
        parts = []
        for name, algorithm, map, told, seeds in variants(task):
            driven = f"map.file={folder / task}-nht.safetensors" if map == "nht" else "map=none"
            run = folder / f"{task}-{name.lower().replace(', ', '-')}"
            asked = [f"env={task}", driven, "map.action_scale=1", f"demos.path={folder / task}-demos"]
            runs = trained_runs(run, [*told, *asked], seeds, algorithm)
            parts.append(runs.assign(interface=name))
            curves = pandas.concat(parts, ignore_index=True)
            save(curves, OUT, task)
            plot(curves, OUT / f"{task}.png", LOOKS)


if __name__ == "__main__":
    main()
