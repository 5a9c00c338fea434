"""Draws the committed figures of ``benchmarks/results`` again from the committed rows: nothing is trained or measured.

Figures of maps and films need the maps and policies themselves, which are not committed.

    python benchmarks/learning/redraw.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas

from nht.recipes.compare_maps import plot_errors
from nht.recipes.study.curves import plot
from nht.recipes.study.report import write_report

RESULTS = Path(__file__).parents[1] / "results"

CURVES = {
    "wam_wipe": ("success", "WAMWipe, DDPG, start fixed", "interface"),
    "wam_grasp": ("success", "WAMGrasp, DDPG, k = 3", "interface"),
    "half_cheetah": ("return", "HalfCheetah, PPO", "interface"),
    "half_cheetah_off_policy": ("return", "HalfCheetah, raw torques", "algorithm"),
}
"""Of each folder with ``curves.csv``: what its figure shows, its title, and what its lines are."""


def main() -> None:
    """Draw all of them."""
    sys.path += [str(RESULTS.parent / folder) for folder in ("learning", "speed")]  # scripts, no package
    import batch_scaling
    import demos_in_replay
    import grasp_ceiling
    import half_cheetah_interfaces
    import half_cheetah_planes
    import hard_corner
    import imitation
    import population

    import populations

    for name, (metric, title, lines) in CURVES.items():
        curves = pandas.read_csv(RESULTS / name / "curves.csv")
        plot(curves, metric, title, RESULTS / name / f"{metric}.png", lines)
    for name in ("half_cheetah_interfaces", "half_cheetah_teachers"):
        half_cheetah_interfaces.draw(pandas.read_csv(RESULTS / name / "curves.csv"), RESULTS / name)
    half_cheetah_planes.draw(pandas.read_csv(half_cheetah_planes.RESULTS / "planes.csv"))
    for name in ("search_wam_wipe", "search_wam_grasp", "search_wam_grasp_1m"):
        write_report(RESULTS / name / "rows.csv", RESULTS / name / "report", "")
    for table in sorted((RESULTS / "compare_maps").glob("*/table.csv")):
        plot_errors(pandas.read_csv(table), table.with_name("error.png"))
    for task in demos_in_replay.TASKS:
        curves = pandas.read_csv(demos_in_replay.OUT / f"{task}.csv")
        populations.plot(curves, demos_in_replay.OUT / f"{task}.png", demos_in_replay.LOOKS)
    curves = pandas.read_csv(imitation.OUT / "wam_grasp.csv")
    populations.plot(curves, imitation.OUT / "wam_grasp.png", imitation.LOOKS)
    for name in ("wam_grasp", "wam_grasp_longer"):
        grasp_ceiling.draw(pandas.read_csv(grasp_ceiling.OUT / f"{name}.csv"), name)
    hard_corner.draw(pandas.read_csv(hard_corner.OUT / "wam_wipe.csv"))
    population.draw(pandas.read_csv(population.OUT / "rounds.csv"))
    scaling = pandas.read_csv(batch_scaling.RESULTS.with_suffix(".csv"), comment="#")
    batch_scaling.plot(scaling.to_dict("records"), "half_cheetah")


if __name__ == "__main__":
    main()
