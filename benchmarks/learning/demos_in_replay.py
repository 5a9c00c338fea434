"""DDPG on both arm tasks with and without demonstrations in its replay, through NHT and with raw joints, five seeds.

Each row of a task's table is one population of five seeds. A population that is finished is not repeated, one that was
interrupted goes on. Writes every evaluation, a table and a figure a task to ``results/demos_in_replay``.

    python -m nht.recipes.collect_demos env=wam_grasp demos.transitions=100_000 out=FOLDER/wam_grasp-demos
    data="env=wam_grasp demos.path=FOLDER/wam_grasp-demos"    # and the same for wam_wipe, with map.action_dim=2
    python -m nht.recipes.train_map $data map=nht map.action_dim=3 out=FOLDER/wam_grasp-nht.safetensors
    python benchmarks/learning/demos_in_replay.py FOLDER [TASK ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas

from nht.recipes.study.figures import colour
from populations import ARMS, plot, save, trained_runs

OUT = Path(__file__).parents[1] / "results" / "demos_in_replay"
DEMOS = 10_000
TASKS = {
    "wam_grasp": ["algo=ddpg_grasp", "map.action_scale=1", "algo.total_frames=200_000"],
    "wam_wipe": ["map.action_scale=1", "algo.total_frames=100_000"],
}
WAYS = {
    "none": [],
    "prefilled": [f"algo.demos.transitions={DEMOS}"],
    "a quarter": [f"algo.demos.transitions={DEMOS}", "algo.demos.share=0.25"],
}
"""How demonstrations take part: not at all, in the replay buffer, as a quarter of each minibatch."""
STYLES = {"none": ":", "prefilled": "--", "a quarter": "-"}


LOOKS = {f"{map}, {way}": (colour(map), style) for map in ("nht", "raw") for way, style in STYLES.items()}


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    for task in sys.argv[2:] or TASKS:
        parts = []
        for interface in ("nht", "raw"):
            driven = f"map.file={folder / task}-nht.safetensors" if interface == "nht" else "map=none"
            for way, demos in WAYS.items():
                told = [
                    f"env={task}",
                    driven,
                    f"demos.path={folder / task}-demos",
                    *TASKS[task],
                    *ARMS,
                    *demos,
                ]
                runs = trained_runs(folder / f"{task}-{interface}-{way.replace(' ', '-')}", told)
                parts.append(runs.assign(interface=f"{interface}, {way}"))
                curves = pandas.concat(parts, ignore_index=True)
                save(curves, OUT, task)
                plot(curves, OUT / f"{task}.png", LOOKS)


if __name__ == "__main__":
    main()
