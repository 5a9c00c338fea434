"""WAMWipe's hard corner through every interface, with and without demonstrations in replay, and what it breaks.

Random starts, elbows swivelled by up to 1 rad, a tolerance of 5 mm; DDPG, 160,000 steps, five seeds. Maps are trained
on the expert's 20,000 transitions (k = 2), of which 10,000 stand in the replay buffer where demonstrations take part.
Writes rows, a table, curves, and success against the share of training episodes that violate the constraint, to
``results/hard_corner``.

    python benchmarks/learning/hard_corner.py FOLDER [INTERFACE ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas

from nht.recipes.figure_style import PAGE, save_figure, style
from nht.recipes.run.metrics import FAILURE, FRAMES, SUCCESS, tested, trained
from nht.recipes.study.figures import colour
from nht.recipes.study.scores import interval
from populations import ARMS, made, plot, save, trained_runs

OUT = Path(__file__).parents[1] / "results" / "hard_corner"
CORNER = [
    "env=wam_wipe",
    "env.options.start=random",
    "env.options.swivel_range=1.0",
    "env.options.height_tolerance=0.005",
]
LEARNER = [*CORNER, *ARMS, "map.action_scale=1", "algo.total_frames=160_000"]
INTERFACES = ("nht", "svd", "scl", "laser", "jacobian", "raw")
WAYS = {"": ([], ":"), ", demonstrations": (["algo.demos.transitions=10_000"], "-")}
LOOKS = {
    f"{interface}{way}": (colour(interface), line)
    for interface in INTERFACES
    for way, (_, line) in WAYS.items()
}


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    demos = made(folder / "demos", "collect_demos", [*CORNER, "demos.transitions=20_000"])
    parts = []
    for interface in sys.argv[2:] or INTERFACES:
        for way, (more, _) in WAYS.items():
            run = folder / f"{interface}{way.replace(', ', '-')}"
            driven = interface_of(interface, demos, folder)
            runs = trained_runs(run, [*LEARNER, *driven, f"demos.path={demos}", *more])
            parts.append(runs.assign(interface=f"{interface}{way}"))
            save(pandas.concat(parts, ignore_index=True), OUT, "wam_wipe")
    draw(pandas.concat(parts, ignore_index=True))


def draw(curves: pandas.DataFrame) -> None:
    """Both figures."""
    plot(curves, OUT / "curves.png", LOOKS)
    violations(curves, OUT / "violations.png")


def interface_of(kind: str, demos: Path, folder: Path) -> list[str]:
    """The settings of an interface, whose map is trained if it has one to train."""
    if kind in ("raw", "jacobian"):
        return ["map=none" if kind == "raw" else "map=jacobian"]
    told = [*CORNER, f"demos.path={demos}", f"map={kind}", "map.action_dim=2"]
    return [f"map={kind}", f"map.file={made(folder / f'{kind}.safetensors', 'train_map', told)}"]


@style()
def violations(curves: pandas.DataFrame, file: Path) -> None:
    """Success at the end against the share of training episodes that violated the constraint: seeds, and means."""
    figure, axes = plt.subplots(figsize=(0.75 * PAGE, 0.45 * PAGE), layout="constrained")
    for name, group in curves.groupby("interface", sort=False):
        seeds = group.groupby("seed")
        broken, success = seeds[trained(FAILURE)].mean(), group[group[FRAMES] == group[FRAMES].max()]
        success = success.set_index("seed")[tested(SUCCESS)]
        own, line = LOOKS[str(name)]
        face = own if line == "-" else "none"
        axes.scatter(broken, success, s=14, facecolors=face, edgecolors=own, alpha=0.5)
        low, high = interval(success.to_numpy())
        middle = np.array([[success.mean() - low], [high - success.mean()]]).clip(0)
        axes.errorbar(
            broken.mean(), success.mean(), middle, fmt="o", ms=8, color=own, markerfacecolor=face, label=name
        )
    axes.set(
        xlabel="training episodes that violated the constraint",
        ylabel="success after training",
        xlim=(-0.02, 1.02),
        ylim=(-0.05, 1.05),
    )
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    save_figure(figure, file)


if __name__ == "__main__":
    main()
