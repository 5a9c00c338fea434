"""Action maps side by side: each is trained on the same demonstrations, then measured.

python -m nht.recipes.compare_maps demos.path=runs/demos-wam_wipe maps=[nht,laser,svd,scl] action_dims=[1,2,3]
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import pandas
import torch

import nht
from nht.recipes.config import CompareMaps, EnvConfig
from nht.recipes.launch import launch
from nht.recipes.train_map import KINDS, train_map

FIXED = ("jacobian", "none")  # kinds whose action has the width it has
PAIRS = 5_000  # of contexts, to see how fast a basis changes
LATENCY_SECONDS = 0.5  # spent on each measurement


def main(config: CompareMaps) -> None:
    """Train and measure every map; write ``table.csv``, ``table.md`` and ``error.png``, and print the table."""
    out = Path(config.out)
    if out.exists():
        raise FileExistsError(f"{out} exists: comparisons are never overwritten. Choose another folder.")
    if config.demos.path is None:
        raise ValueError("demos.path must name the demonstrations that all maps are trained on.")
    if unknown := set(config.maps) - KINDS.keys():
        raise ValueError(f"unknown map kinds {sorted(unknown)}: choose from {sorted(KINDS)}.")
    if not config.maps or not config.action_dims:
        raise ValueError(f"nothing to compare: got maps={config.maps} and action_dims={config.action_dims}.")
    rows = []
    for kind in config.maps:
        for action_dim in config.action_dims[:1] if kind in FIXED else config.action_dims:
            rows.append({"map": kind, **_measured(config, kind, action_dim)})
    table = pandas.DataFrame(rows)
    out.mkdir(parents=True)
    table.to_csv(out / "table.csv", index=False)
    (out / "table.md").write_text(_markdown(table))
    _plot(table, out / "error.png")
    print((out / "table.md").read_text())
    print(f"saved in {out}")


def _measured(config: CompareMaps, kind: str, action_dim: int) -> dict[str, float]:
    env = config.env
    if kind == "jacobian":
        env = replace(env, context_keys=["joint_angle"])
    settings = replace(config.map, kind=kind, action_dim=action_dim)
    map, metrics = train_map(settings, env, config.demos, config.seed)
    return {
        "k": map.action_dim,
        "validation_error": metrics["validation_error"],
        "certificate": metrics["certificate"],
        "largest_ratio": _largest_ratio(map, config.demos.path or "", env),
        "parameters": sum(weight.numel() for weight in map.parameters()),
        "training_seconds": metrics["seconds"],
        "latency_1_us": 1e6 * latency(map, 1),
        "latency_4096_us": 1e6 * latency(map, 4096),
    }


@torch.no_grad()
def _largest_ratio(map: nht.ActionMap, path: str, env: EnvConfig) -> float:
    """The largest |Q(c) - Q(c')| / |c - c'| seen, between neighbours in time: NaN for maps without a basis."""
    if not isinstance(map, nht.LinearActionMap):
        return float("nan")
    context = nht.load_demos(path).context(env.context_keys)[: PAIRS + 1]
    basis = map.basis(context)
    change = torch.linalg.matrix_norm(basis[1:] - basis[:-1], ord=2)
    distance = (context[1:] - context[:-1]).norm(dim=-1)
    moved = distance > 1e-3  # below, a ratio is mostly rounding
    return float((change / distance)[moved].max()) if moved.any() else float("nan")


@torch.no_grad()
def latency(map: nht.ActionMap, batch: int) -> float:
    """Median time of one batch of actuations [s], after a warm-up."""
    action, context = torch.ones(batch, map.action_dim), torch.zeros(batch, map.context_dim)
    times: list[float] = []
    start = time.perf_counter()
    while len(times) < 20 or time.perf_counter() - start < LATENCY_SECONDS:
        begin = time.perf_counter()
        map(action, context)
        times.append(time.perf_counter() - begin)
    return statistics.median(times[len(times) // 4 :])


def _markdown(table: pandas.DataFrame) -> str:
    lines = ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    for row in table.itertuples(index=False):
        cells = [
            "-" if value != value else f"{value:.4g}" if not isinstance(value, str) else value
            for value in row
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _plot(table: pandas.DataFrame, path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for kind, rows in table.groupby("map", sort=False):
        axes.plot(rows["k"], rows["validation_error"].clip(lower=1e-9), marker="o", label=str(kind))
    axes.set(xlabel="action dimensions k", ylabel="held-out error |u - û|² / |u|²", yscale="log")
    axes.set_xticks(sorted(table["k"].unique()))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    launch(main, CompareMaps, "compare_maps")
