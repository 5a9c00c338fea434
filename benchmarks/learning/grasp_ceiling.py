"""What lifts NHT's ceiling on WAMGrasp: another dimension, corrections, or demonstrations beside the expert's way.

DDPG with 10,000 of the expert's steps in replay, 200,000 steps, five seeds, through NHTs that differ in k and in what
they were trained on, 100,000 transitions each:

- ``clean``: the expert's own episodes.
- ``disturbed``: noise moves the arm off the expert's way, its answers are recorded (DART).
- ``relabelled``: an agent that learned through the clean map drives every other copy, the expert's answers are
  recorded in all (DAgger).

``corrected`` adds a residual of 0.3 rad/s. The best of them then learn for 1,000,000 steps with five fresh seeds.
Writes rows, tables and figures to ``results/grasp_ceiling``.

    python benchmarks/learning/grasp_ceiling.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas

from populations import ARMS, made, plot, save, trained_runs

OUT = Path(__file__).parents[1] / "results" / "grasp_ceiling"
TASK = ["env=wam_grasp", "demos.transitions=100_000"]
LEARNER = [*ARMS, "env=wam_grasp", "algo=ddpg_grasp", "map.action_scale=1"]
COLOURS = {"clean": "#0072B2", "disturbed": "#D55E00", "relabelled": "#009E73"}
CORRECTIONS = {"": [], ", corrected": ["map.residual=0.3"]}
VARIANTS = [
    ("clean", 3, ""),
    ("clean", 4, ""),
    ("disturbed", 3, ""),
    ("disturbed", 4, ""),
    ("relabelled", 3, ""),
    ("relabelled", 4, ""),
    ("clean", 3, ", corrected"),
    ("clean", 4, ", corrected"),
]
LOOKS = {
    f"{kind}, k = {action_dim}": (COLOURS[kind], "-" if action_dim == 4 else "--")
    for kind, action_dim, corrected in VARIANTS
    if not corrected
}
"""Of the curves; corrections, which do not pay, are in the table only."""
LONGER, FRESH = [("clean", 4, ""), ("disturbed", 3, "")], range(100, 105)
"""What learns for 1,000,000 steps, and its seeds."""


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    parts, longer = [], []
    for variant in VARIANTS:
        name, told = learner(variant, folder)
        runs = trained_runs(folder / plain_name(name), [*told, "algo.total_frames=200_000"])
        parts.append(runs.assign(interface=name))
        save(pandas.concat(parts, ignore_index=True), OUT, "wam_grasp")
    draw(pandas.concat(parts, ignore_index=True), "wam_grasp")
    for variant in LONGER:
        name, told = learner(variant, folder)
        tested = ["algo.total_frames=1_000_000", "evaluation.final_episodes=200"]
        runs = trained_runs(folder / f"{plain_name(name)}-longer", [*told, *tested], FRESH)
        longer.append(runs.assign(interface=name))
        save(pandas.concat(longer, ignore_index=True), OUT, "wam_grasp_longer")
    draw(pandas.concat(longer, ignore_index=True), "wam_grasp_longer")


def draw(curves: pandas.DataFrame, name: str) -> None:
    """The figure beside the rows of that name."""
    plot(curves[curves["interface"].isin(LOOKS)], OUT / f"{name}.png", LOOKS)


def learner(variant: tuple[str, int, str], folder: Path) -> tuple[str, list[str]]:
    """The name and the settings of a variant, whose demonstrations and map are made first if need be."""
    kind, action_dim, corrected = variant
    demos = made(folder / kind, "collect_demos", [*TASK, *source(kind, folder)])
    map = made(
        folder / f"{kind}-{action_dim}.safetensors",
        "train_map",
        ["env=wam_grasp", f"demos.path={demos}", "map=nht", f"map.action_dim={action_dim}"],
    )
    replayed = [f"demos.path={folder / 'clean'}", "algo.demos.transitions=10_000"]
    name = f"{kind}, k = {action_dim}{corrected}"
    return name, [*LEARNER, *CORRECTIONS[corrected], f"map.file={map}", *replayed]


def plain_name(name: str) -> str:
    """Of a folder."""
    return name.replace(", ", "-").replace(" = ", "")


def source(kind: str, folder: Path) -> list[str]:
    """Settings of the demonstrations of a kind."""
    if kind == "disturbed":
        return ["demos.disturbance=0.1"]
    if kind == "relabelled":
        return ["source=policy", "source.relabel=true", f"source.path={folder / 'clean-k3' / 'seed-0'}"]
    return []


if __name__ == "__main__":
    main()
