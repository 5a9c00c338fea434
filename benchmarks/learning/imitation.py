"""What imitating demonstrations adds to replaying them: DDPG on WAMGrasp, through NHT and with raw joints, five seeds.

Beside a quarter of each minibatch, which is demonstrated in all of them:

- ``start``: the actor first takes 2,000 gradient steps of behaviour cloning.
- ``term``: its loss has the squared distance to the demonstrated actions, with a weight of 1 that falls to 0 within
  100,000 steps.
- ``filtered``: that, only where the critic prefers the demonstrated action.

In the folder of ``demos_in_replay.py``, with its demonstrations and map, whose runs of a quarter are taken from its
rows. Writes rows, a table and a figure to ``results/imitation``.

    python benchmarks/learning/imitation.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import demos_in_replay
import pandas

from nht.recipes.study.figures import colour
from populations import ARMS, plot, save, trained_runs

OUT = Path(__file__).parents[1] / "results" / "imitation"
FADING = ["algo.demos.cloning=1", "algo.demos.cloning_frames=100_000"]
WAYS = {
    "start": ["algo.demos.cloning_start=2_000"],
    "term": FADING,
    "filtered": [*FADING, "algo.demos.q_filter=true"],
}
STYLES = {"a quarter": ":", "start": "-", "term": "--", "filtered": "-."}
LOOKS = {f"{map}, {way}": (colour(map), style) for map in ("nht", "raw") for way, style in STYLES.items()}


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    known = pandas.read_csv(demos_in_replay.OUT / "wam_grasp.csv")
    parts = [known[known["interface"].isin(LOOKS)]]
    for way, imitated in WAYS.items():
        for interface in ("nht", "raw"):
            driven = f"map.file={folder / 'wam_grasp-nht.safetensors'}" if interface == "nht" else "map=none"
            demos = [
                f"demos.path={folder / 'wam_grasp-demos'}",
                *demos_in_replay.WAYS["a quarter"],
                *imitated,
            ]
            told = ["env=wam_grasp", driven, *demos_in_replay.TASKS["wam_grasp"], *ARMS, *demos]
            runs = trained_runs(folder / f"wam_grasp-{interface}-{way}", told)
            parts.append(runs.assign(interface=f"{interface}, {way}"))
            curves = pandas.concat(parts, ignore_index=True)
            save(curves, OUT, "wam_grasp")
            plot(curves, OUT / "wam_grasp.png", LOOKS)


if __name__ == "__main__":
    main()
