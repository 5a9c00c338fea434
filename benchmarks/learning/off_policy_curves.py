"""DDPG, TD3 and SAC on HalfCheetah side by side: from the folders of runs to rows, table and figure.

Rows of DDPG that were recorded earlier, in ``results/half_cheetah/ddpg.csv``, are taken from there for the seeds that
the folders hold no run of. Writes ``curves.csv``, ``table.md`` and ``return.png`` to
``results/half_cheetah_off_policy``.

    python benchmarks/learning/off_policy_curves.py runs/half_cheetah-off-policy
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas

from nht.recipes.study.curves import plot, read_runs, summarise
from nht.recipes.study.report import to_markdown

RESULTS = Path(__file__).parents[1] / "results"
COLUMNS = ["task", "algorithm", "interface", "seed", "frames", "eval_return", "updates", "seconds"]
EVERY, STEPS = 20_000, 300_000


def recorded_ddpg() -> pandas.DataFrame:
    """The runs of 300,000 steps with today's learning rates, in float32, at the evaluations that all runs make."""
    rows = pandas.read_csv(RESULTS / "half_cheetah" / "ddpg.csv")
    chosen = (rows["learning_rate"] == 3e-4) & ~rows["bfloat16"] & (rows["frames"] % EVERY == 0)
    rows = rows[chosen].groupby("seed").filter(lambda run: run["frames"].max() >= STEPS)
    return rows.assign(task="half_cheetah", algorithm="ddpg", interface="raw")


def main(folders: list[Path]) -> None:
    """Write rows, table and figure; print the table."""
    curves = read_runs(folders)
    earlier = recorded_ddpg()
    found = set(zip(curves["algorithm"], curves["seed"], strict=True))
    fresh = [pair not in found for pair in zip(earlier["algorithm"], earlier["seed"], strict=True)]
    curves = pandas.concat([curves, earlier[fresh]], ignore_index=True)
    curves = curves.sort_values(["algorithm", "seed", "frames"])
    out = RESULTS / "half_cheetah_off_policy"
    out.mkdir(exist_ok=True)
    curves[COLUMNS].round(1).to_csv(out / "curves.csv", index=False)
    table = summarise(curves, "return", "algorithm")
    (out / "table.md").write_text(to_markdown(table))
    plot(curves, "return", "HalfCheetah, raw torques", out / "return.png", "algorithm")
    print(table.to_string(index=False))


if __name__ == "__main__":
    main([Path(folder) for folder in sys.argv[1:]])
