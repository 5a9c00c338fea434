"""Figures of maps: the basis along a demonstration, and how the action axes move the tool of an arm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor
from torch.func import jacfwd, vmap

import nht
from nht.recipes.figure_style import PAGE, looks, save_figure, style

LONGEST = 100  # steps of a demonstration that can still be told apart
GRID = 9  # arrows along the longer side of the area where the tool was
STEEP = Normalize(-0.1, 0.1)  # the vertical share of a motion within which its colour changes
SLOPES = LinearSegmentedColormap.from_list("slopes", ["#1a73e8", "#202020", "#e8331a"])
"""Blue for down, black for level, red for up."""


@style()
def basis_figure(maps: Mapping[str, nht.ActionMap], demos: nht.Demos, episode: int, path: str | Path) -> None:
    """Plot the bases of maps along a demonstration: a column of panels per map, a row per basis vector.

    A panel has a line for each motor; of a long demonstration it shows the first steps. For a map that is not linear,
    ``local_basis`` takes the place of the basis. Both are shown times ``action_scale``, as the actuation that an action
    of 1 adds, and all panels have one scale.

    Args:
        maps: trained maps, by the name to show.
        demos: demonstrations that have the maps' context keys.
        episode: which of them.
        path: of the PNG file.

    Raises:
        ValueError: if there is no such episode, or a map is not trained.
    """
    rows = (demos.episode == episode).nonzero().flatten()[:LONGEST]
    if not len(rows):
        raise ValueError(f"there is no episode {episode}: the last is {int(demos.episode.max())}.")
    actuation = demos.actuation[rows]
    axes = max(map.action_dim for map in maps.values())
    width = min(1.6, (PAGE - 0.5) / len(maps))
    figure, panels = _panels(
        axes, len(maps), width=width, height=max(1.1, 0.8 * width), sharex=True, sharey=True
    )
    reach = 1.0
    for (name, map), column in zip(maps.items(), panels.T, strict=True):
        basis = float(map.action_scale) * local_basis(map, demos.context(_keys(map))[rows], actuation)
        reach = max(reach, float(basis.abs().max()))
        for entries, panel in zip(basis.unbind(-1), column[: map.action_dim], strict=True):
            for line, look in zip(entries.unbind(-1), looks(entries.shape[-1]), strict=True):
                panel.plot(line, **look)
            panel.axhline(0, color="0.5", linewidth=0.6, zorder=1)
            panel.set_xlim(0, max(1, len(actuation) - 1))
        kind = "basis" if isinstance(map, nht.LinearActionMap) else "derivative"
        column[0].set_title(f"{name}: {kind}", loc="center")
        column[-1].set_xlabel("step")
    panels[0, 0].set_ylim(-1.05 * reach, 1.05 * reach)
    motors = [f"motor {motor + 1}" for motor in range(actuation.shape[-1])]
    columns = max(2, int(figure.get_figwidth() / 0.75))  # as many as there is room for
    figure.legend(panels[0, 0].lines[:-1], motors, loc="outside lower center", ncols=min(7, columns))
    save_figure(figure, path)


@style()
def tool_figure(
    maps: Mapping[str, nht.ActionMap], demos: nht.Demos, arm: nht.JacobianPinv, axes: int, path: str | Path
) -> None:
    """Plot how each action axis moves the tool, seen from above: a column of panels per map, a row per axis.

    Dots are demonstrated positions of the tool, those nearest to a grid; an arrow from each is the tool's velocity
    for an action on that axis, drawn to one scale for all axes of a map. The colour is the vertical share of the
    motion, so that a dot without an arrow moves straight up or down, or not at all.

    Args:
        maps: trained maps, by the name to show.
        demos: demonstrations that have "joint_angle" (T, n) and "tool_position" (T, 3), and the maps' context keys.
        arm: what moves the tool.
        axes: how many of the action axes to show.
        path: of the PNG file.

    Raises:
        ValueError: if a map is not trained.
    """
    position = demos.data["tool_position"]
    rows = near_grid(position[:, :2])
    position = position[rows]
    jacobian = arm.jacobian(demos.data["joint_angle"][rows])[:, :3]
    width = min(1.3, (PAGE - 0.7) / len(maps))
    figure, panels = _panels(
        axes, len(maps), width=width, height=1.25 * width + 0.1, unit="\ny [m]", sharex=True, sharey=True
    )
    for (name, map), column in zip(maps.items(), panels.T, strict=True):
        velocity = (jacobian @ axis_motion(map, demos.context(_keys(map))[rows]))[..., :axes]
        longest = float(velocity[:, :2].norm(dim=1).max())
        for moved, panel in zip(velocity.unbind(-1), column[: map.action_dim], strict=True):
            _quiver(panel, position, moved, longest)
        shown = "" if map.action_dim == axes else f" ({min(axes, map.action_dim)} of {map.action_dim} axes)"
        column[0].set_title(name + shown, loc="center", fontsize=8 if not shown or width > 1.1 else 6)
        column[-1].set_xlabel("x [m]")
    share = min(0.9, 2.6 / figure.get_figwidth())  # of the width
    bar = figure.colorbar(
        ScalarMappable(STEEP, SLOPES),
        ax=figure.axes,
        location="bottom",
        shrink=share,
        aspect=30,
        extend="both",
    )
    bar.set_ticks([-0.1, 0, 0.1], labels=["10 % down", "level", "10 % up"])
    save_figure(figure, path)


@torch.no_grad()
def local_basis(map: nht.ActionMap, context: Tensor, actuation: Tensor) -> Tensor:
    """Q(c); for a map that is not linear, the derivative of the actuation at the projected demonstrated action.

    Args:
        map: any map.
        context: (T, context_dim).
        actuation: demonstrated there, (T, n).

    Returns:
        (T, n, k).
    """
    if isinstance(map, nht.LinearActionMap):
        return map.basis(context)
    return vmap(jacfwd(map))(map.project(actuation, context), context)


@torch.no_grad()
def axis_motion(map: nht.ActionMap, context: Tensor) -> Tensor:
    """The change of the actuation from action 0 to an action of ``action_scale`` on each axis.

    Args:
        map: any map.
        context: (T, context_dim).

    Returns:
        (T, n, k).
    """
    actions = map.action_scale * torch.eye(map.action_dim)
    still = map(torch.zeros(len(context), map.action_dim), context)
    return torch.stack([map(action.expand(len(context), -1), context) - still for action in actions], dim=-1)


def near_grid(points: Tensor) -> Tensor:
    """Indices of the points (T, 2) that are nearest to the nodes of a grid over them, where any are near."""
    low, high = points.amin(0), points.amax(0)
    step = (high - low).max().clamp_min(1e-9) / GRID
    counts = ((high - low) / step).round().int().clamp_min(1).tolist()
    sides = (torch.arange(count) - (count - 1) / 2 for count in counts)
    nodes = (low + high) / 2 + step * torch.cartesian_prod(*sides)
    nearest = torch.cdist(nodes, points).min(1)
    return nearest.indices[nearest.values <= step / 2].unique()


def _quiver(panel: Axes, position: Tensor, velocity: Tensor, longest: float) -> None:
    """Dots at (T, 3) and arrows along (T, 3), the longest as long as the grid is wide."""
    slope = velocity[:, 2] / velocity.norm(dim=1).clamp_min(1e-9)
    spread = float((position.amax(0) - position.amin(0)).max()) / GRID
    x, y = position[:, :2].mT
    panel.scatter(x, y, c=slope, s=1.5, linewidth=0, cmap=SLOPES, norm=STEEP)
    panel.quiver(
        *(x, y, *velocity[:, :2].mT, slope),
        cmap=SLOPES,
        norm=STEEP,
        angles="xy",
        scale_units="xy",
        scale=max(longest, 1e-9) / spread,
        width=0.012,
    )
    panel.set_aspect("equal")
    panel.margins(0.12)


def _panels(
    rows: int,
    columns: int,
    *,
    width: float,
    height: float,
    unit: str = "",
    sharex: bool = False,
    sharey: bool = False,
) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of ``(rows, columns)`` panels of a size [inch], a row for each action axis."""
    size = (width * columns + 0.5, height * rows + 0.6)
    figure, panels = plt.subplots(
        rows, columns, figsize=size, layout="constrained", squeeze=False, sharex=sharex, sharey=sharey
    )
    for axis, panel in enumerate(panels[:, 0]):
        panel.set_ylabel(f"axis {axis + 1}{unit}")
    return figure, panels


def _keys(map: nht.ActionMap) -> list[str]:
    if map.context_keys is None:
        raise ValueError(f"this {type(map).__name__} is not trained: it has no context keys.")
    return list(map.context_keys)
