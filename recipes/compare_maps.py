"""Action maps side by side: each is trained on the same demonstrations, then measured and drawn.

python -m nht.recipes.compare_maps demos.path=runs/demos-wam_wipe maps=[nht,laser,svd,scl] action_dims=[1,2,3]
"""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path

import matplotlib.pyplot as plt
import pandas
import torch

import nht
from nht.recipes.config import CompareMaps
from nht.recipes.figure_style import COLUMN, save_figure, style
from nht.recipes.launch import launch
from nht.recipes.maps.figures import basis_figure, tool_figure
from nht.recipes.maps.interface import trained_map
from nht.recipes.maps.kinds import (
    arm_of,
    find_kind,
    kind_in_file_name,
    make_map,
    map_context_keys,
    tasks_with_arm,
)
from nht.recipes.run.artifacts import demos_files, map_files
from nht.recipes.run.dashboard import Dashboard, shown_on_dashboard, wanted
from nht.recipes.study.figures import colour

PAIRS = 5_000  # of contexts, to see how fast an interface changes
LATENCY_SECONDS = 0.5  # spent on each measurement

HEADINGS = {
    "validation_error": "held-out error",
    "largest_ratio": "largest seen ratio",
    "training_seconds": "trained in [s]",
    "latency_1_us": "latency, batch 1 [us]",
    "latency_4096_us": "batch 4096 [us]",
}


def main(config: CompareMaps) -> None:
    """Train and measure every map; write the table, the figures and the maps, and print the table.

    The folder gets ``table.csv`` and ``table.md``; ``error.png``; for ``map.action_dim`` axes ``basis.png`` and, for
    the task of an arm, ``tool.png``; and every map, in ``maps/``.
    """
    out = Path(config.out)
    if out.exists():
        raise FileExistsError(f"{out} exists: comparisons are never overwritten. Choose another folder.")
    if config.demos.path is None:
        raise ValueError("demos.path must name the demonstrations that all maps are trained on.")
    fixed = {kind for kind in config.maps if find_kind(kind).fixed_width}
    if not config.maps or not config.action_dims:
        raise ValueError(f"nothing to compare: got maps={config.maps} and action_dims={config.action_dims}.")
    wanted(config.run)  # whether W&B is installed, if it is
    torch.set_num_threads(config.torch_threads)
    demos = nht.load_demos(config.demos.path, env=config.env.name)
    chosen = [
        replace(config.map, kind=kind, action_dim=action_dim)
        for kind in config.maps
        for action_dim in (config.action_dims[:1] if kind in fixed else config.action_dims)
    ]
    for settings in chosen:  # whether all can be made, before the first is trained
        width = demos.context(map_context_keys(settings, config.env)).shape[-1]
        make_map(settings, width, demos.actuation.shape[-1], config.seed, config.env)
    rows, maps, table = [], {}, pandas.DataFrame()
    out.mkdir(parents=True)
    for settings in chosen:
        trained = trained_map(settings, config.env, config.demos, config.seed)
        kind, k = settings.kind, trained.map.action_dim
        maps[kind, k] = trained.map
        nht.save_map(trained.map, _map_file(out, kind, k))
        rows.append({"map": kind, "k": k, **_measured(trained, demos)})
        table = pandas.DataFrame(rows)
        table.to_csv(out / "table.csv", index=False)
        (out / "table.md").write_text(_markdown(table))
    plot_errors(table, out / "error.png")
    _draw(config, maps, demos, out)
    with shown_on_dashboard(out, {"recipe": "compare_maps", **asdict(config)}, config.run) as dashboard:
        if dashboard is not None:
            _show(dashboard, table, maps, out, Path(config.demos.path))
    print((out / "table.md").read_text())
    print(f"saved in {out}")


def _show(
    dashboard: Dashboard,
    table: pandas.DataFrame,
    maps: dict[tuple[str, int], nht.ActionMap],
    out: Path,
    demos: Path,
) -> None:
    """Show table and figures, and hand the maps on; of those with as many axes, the one that fits best is the best."""
    dashboard.take(demos_files(demos))
    dashboard.table("maps", table)
    for figure in sorted(out.glob("*.png")):
        dashboard.picture(f"figures/{figure.stem}", figure)
    best = table.loc[table.groupby("k")["validation_error"].idxmin().dropna()]
    best_maps = set(zip(best["map"], best["k"], strict=True))
    for row in table.to_dict("records"):
        kind, k = str(row["map"]), int(row["k"])
        file = _map_file(out, kind, k)
        facts = {str(name): value for name, value in row.items() if name not in ("map", "k")}
        dashboard.add(map_files(file, maps[kind, k], facts, best=(kind, k) in best_maps))


def _map_file(out: Path, kind: str, action_dim: int) -> Path:
    return out / "maps" / f"{kind_in_file_name(kind)}-k{action_dim}.safetensors"


def _measured(trained: nht.MapTraining, demos: nht.Demos) -> dict[str, float]:
    map, metrics = trained
    context = demos.context(map.context_keys or ())[: PAIRS + 1]
    return {
        "validation_error": metrics["validation_error"],
        "certificate": metrics["certificate"],
        "largest_ratio": largest_ratio(map, context),
        "parameters": sum(weight.numel() for weight in map.parameters()),
        "training_seconds": metrics["seconds"],
        "latency_1_us": 1e6 * latency(map, 1),
        "latency_4096_us": 1e6 * latency(map, 4096),
    }


@torch.no_grad()
def largest_ratio(map: nht.ActionMap, context: torch.Tensor) -> float:
    """How fast the interface changes with the context, at most, between neighbours in time.

    For a linear map, the largest |Q(c) - Q(c')| / |c - c'|, in the spectral norm. For any other, which has no basis,
    the largest |u(a, c) - u(a, c')| / (|a| |c - c'|) for the fixed actions a of plus and minus ``action_scale`` on an
    axis.

    Args:
        map: any map.
        context: (T, context_dim), in order of time.

    Returns:
        NaN if the context never changes.
    """
    if isinstance(map, nht.LinearActionMap):
        basis = map.basis(context)
        change = torch.linalg.matrix_norm(basis[1:] - basis[:-1], ord=2)
    else:
        axes = torch.eye(map.action_dim)
        actions = map.action_scale * torch.cat([axes, -axes])
        actuation = torch.stack([map(action.expand(len(context), -1), context) for action in actions])
        change = (actuation[:, 1:] - actuation[:, :-1]).norm(dim=-1).amax(0) / map.action_scale
    distance = (context[1:] - context[:-1]).norm(dim=-1)
    moved = distance > 1e-3  # below, a ratio is mostly rounding
    return float((change / distance)[moved].max()) if moved.any() else float("nan")


@torch.no_grad()
def latency(map: nht.ActionMap, batch: int) -> float:
    """Shortest time of one batch of actuations [s]: the measure that other programs on the same cores disturb least."""
    action, context = torch.ones(batch, map.action_dim), torch.zeros(batch, map.context_dim)
    times: list[float] = []
    start = time.perf_counter()
    while len(times) < 20 or time.perf_counter() - start < LATENCY_SECONDS:
        begin = time.perf_counter()
        map(action, context)
        times.append(time.perf_counter() - begin)
    return min(times)


def _draw(
    config: CompareMaps, maps: dict[tuple[str, int], nht.ActionMap], demos: nht.Demos, out: Path
) -> None:
    """Draw the maps with ``map.action_dim`` axes, or else with the first of ``action_dims``."""
    dims = config.action_dims
    axes = config.map.action_dim if config.map.action_dim in dims else dims[0]
    chosen = {kind: map for (kind, k), map in maps.items() if k == axes or find_kind(kind).fixed_width}
    with_columns = {kind: map for kind, map in chosen.items() if not find_kind(kind).fixed_width}
    if with_columns:
        longest = int(demos.episode.bincount().argmax())
        basis_figure(with_columns, demos, longest, out / "basis.png")
    if config.env.name in tasks_with_arm():
        tool_figure(chosen, demos, arm_of(config.env.name), axes, out / "tool.png")


def _markdown(table: pandas.DataFrame) -> str:
    headings = [HEADINGS.get(column, column) for column in table.columns]
    lines = ["| " + " | ".join(headings) + " |", "|" + "---|" * len(headings)]
    for row in table.itertuples(index=False):
        lines.append("| " + " | ".join(map(_cell, row)) + " |")
    return "\n".join(lines) + "\n"


def _cell(value: str | float) -> str:
    if isinstance(value, str):
        return value
    if value != value:
        return "-"
    return f"{value:,.0f}" if 1000 <= value < float("inf") else f"{value:.3g}"


def plot_errors(table: pandas.DataFrame, path: Path) -> None:
    """Plot the error against k. The legend names maps with error 0, which a logarithmic axis cannot show."""
    with style():
        figure, axes = plt.subplots(figsize=(1.4 * COLUMN, COLUMN * 0.8), layout="constrained")
        for kind, rows in table.groupby("map", sort=False):
            error = rows["validation_error"].where(rows["validation_error"] > 0)
            label = str(kind) if error.notna().any() else f"{kind} (k = {rows['k'].iloc[0]}): exact"
            axes.plot(rows["k"], error, marker="o", label=label, color=colour(str(kind)))
        axes.set(xlabel="action dimensions k", ylabel="held-out error, share of |u|²", yscale="log")
        axes.set_xticks(sorted(table["k"].unique()))
        figure.legend(loc="outside right upper")
        save_figure(figure, path)


if __name__ == "__main__":
    launch(main, CompareMaps, "compare_maps")
