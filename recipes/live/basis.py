"""The basis of an interface, drawn: an arrow at the tool for each action axis, and each motor's share as bars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import mujoco
import numpy as np
from numpy.typing import NDArray
from viser import SceneApi

from nht.envs.arrays import Array
from nht.recipes.live.session import Session
from nht.recipes.live.stage import WORLD, PosedNode
from nht.recipes.live.tool import Tool, angle_to_jacobian, rises

AXIS_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A4FB5")
"""Of the action axes, in order: Okabe and Ito's, which the colour-blind can tell apart, and one more."""
AHEAD = 0.4
"""An arrow ends where the tool would be after so many seconds of an action of 1 on its axis alone."""
LONGEST_ARROW = 0.25
"""Length of the longest arrow where actuations accelerate the tool, as a share of the model's extent."""
NOTICED = 0.02
"""A smaller change of an arrow's length, as a share of it, is not sent."""
X_TO_Z = np.array([math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0])
"""The quaternion that turns x to z."""
SHORTEST_ARROW = 0.004
"""A shorter arrow is left out, as a share of the model's extent."""


@dataclass(frozen=True)
class Basis:
    """What the axes of an interface do in the present state.

    Attributes:
        effects: of an action of 1 on each axis on the motors, ``(n, k)``.
        motion: of an action of 1 on each axis on the tool, linear above angular, ``(6, k)``; None if unknown.
        moves_by: what ``motion`` is, ``"velocity"`` or ``"acceleration"``.
        angle: between the axes' joint motions and those that move the tool [rad]; None where no arm is known.
    """

    effects: Array
    motion: Array | None
    moves_by: str
    angle: float | None


def present_basis(session: Session, tool: Tool) -> Basis:
    """The basis of the chosen interface, where the task stands now."""
    effects = session.interface.axis_effects(session.observed).double().numpy()
    each = tool.motion(len(effects))
    by = tool.moves_by
    angle = angle_to_jacobian(effects, each) if each is not None and by == "velocity" else None
    return Basis(effects, None if each is None else each @ effects, by, angle)


class Arrows:
    """Arrows at the tool, one for each action axis.

    An arrow is drawn along x and turned: browsers follow poses quickly, but new lengths slowly: those are sent only
    when they have changed by more than ``NOTICED``.

    Args:
        scene: of the viewer.
        extent: of the model [m].
    """

    def __init__(self, scene: SceneApi, extent: float) -> None:
        self._scene, self._extent = scene, extent
        self._axes: dict[int, tuple[PosedNode, float]] = {}

    def update(self, basis: Basis | None, tool: Array) -> None:
        """Draw the arrows of a basis at ``tool`` [m], ``(3,)``; None draws none."""
        ways = np.zeros((0, 3)) if basis is None else arrow_ways(basis, self._extent)
        lengths = np.linalg.norm(ways, axis=1)
        shown = {int(axis) for axis in np.flatnonzero(lengths > SHORTEST_ARROW * self._extent)}
        for axis in self._axes.keys() - shown:
            self._axes.pop(axis)[0].node.remove()
        for axis in sorted(shown):
            self._draw(axis, ways[axis], float(lengths[axis]), tool)

    def _draw(self, axis: int, way: Array, length: float, tool: Array) -> None:
        if axis not in self._axes:
            self._axes[axis] = self._made(axis, length), length
        arrow, before = self._axes[axis]
        if abs(length - before) > NOTICED * before:
            arrow.node.points = _along_x(length)
            self._axes[axis] = arrow, length
        turn = np.zeros(4)
        mujoco.mju_quatZ2Vec(turn, way)
        full = np.zeros(4)
        mujoco.mju_mulQuat(full, turn, X_TO_Z)
        arrow.move(tool, full)

    def _made(self, axis: int, length: float) -> PosedNode:
        thick = 0.018 * self._extent
        node = self._scene.add_arrows(
            f"{WORLD}/basis/{axis}",
            _along_x(length),
            linear_rgb(AXIS_COLOURS[axis % len(AXIS_COLOURS)]),
            shaft_radius=0.45 * thick,
            head_radius=thick,
            head_length=2.5 * thick,
        )
        return PosedNode(node)


def _along_x(length: float) -> NDArray[np.float32]:
    return np.array([[[0, 0, 0], [length, 0, 0]]], dtype=np.float32)


def arrow_ways(basis: Basis, extent: float) -> Array:
    """The arrows of a basis, ``(k, 3)`` [m]."""
    if basis.motion is None:
        return np.zeros((0, 3))
    linear = basis.motion[:3].T
    if basis.moves_by == "velocity":
        return linear * AHEAD
    longest = np.linalg.norm(linear, axis=1).max(initial=0.0)
    return linear * (LONGEST_ARROW * extent / longest if longest > 1e-12 else 0.0)


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of ``"#rrggbb"``."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def linear_rgb(colour: str) -> tuple[int, int, int]:
    """A colour as the viewer's arrows take it: in proportion to light, and darker, as its lamps are bright."""
    red, green, blue = (round(160 * (part / 255) ** 2.2) for part in rgb(colour))
    return red, green, blue


def bars_html(basis: Basis, motors: list[str], actuation: Array, bounds: tuple[Array, Array]) -> str:
    """Bars for people to read: each motor's part in each axis, and what it gets now.

    Args:
        basis: the interface's.
        motors: their names, n of them.
        actuation: what they get now, ``(n,)``.
        bounds: lowest and highest actuation, each ``(n,)``.
    """
    largest = max(float(np.abs(basis.effects).max(initial=0.0)), 1e-9)
    limit = np.where(np.isfinite(bounds[1]), np.maximum(np.abs(bounds[0]), np.abs(bounds[1])), largest)
    height = max(12, 4 * basis.effects.shape[1] + 6)
    rows = []
    for name, parts, now, most in zip(motors, basis.effects, actuation, limit, strict=True):
        bars = [
            _bar(part / largest, 2 + 4 * axis, AXIS_COLOURS[axis % len(AXIS_COLOURS)])
            for axis, part in enumerate(parts)
        ]
        bars.append(_bar(float(now) / max(float(most), 1e-9), height - 3, "#888"))
        rows.append(
            f'<div style="display:flex;align-items:center"><span style="width:6.5em;overflow:hidden;'
            f'white-space:nowrap;text-overflow:ellipsis">{escape(name)}</span><svg viewBox="0 0 200 {height}" '
            f'preserveAspectRatio="none" style="flex:1;height:{height}px"><path d="M100 0V{height}" stroke="#bbb"/>'
            f"{''.join(bars)}</svg></div>"
        )
    return f'<div data-basis style="font-size:0.72em;padding:0 0.8em">{"".join(rows)}{_told(basis)}</div>'


def _bar(part: float, top: float, colour: str) -> str:
    length = 98 * min(1.0, abs(part))
    start = 100 if part > 0 else 100 - length
    return f'<rect x="{start:.1f}" y="{top}" width="{length:.1f}" height="3" fill="{colour}"/>'


def _told(basis: Basis) -> str:
    """What the axes do to the tool, in words and numbers."""
    lines = []
    if basis.motion is not None:
        for axis, column in enumerate(basis.motion.T):
            colour = AXIS_COLOURS[axis % len(AXIS_COLOURS)]
            lines.append(f'<b style="color:{colour}">axis {axis + 1}</b> {_motion(column, basis.moves_by)}')
    if basis.angle is not None:
        lines.append(f"angle to the Jacobian {math.degrees(basis.angle):.1f}°")
    return "".join(f"<div>{line}</div>" for line in lines)


def _motion(column: Array, by: str) -> str:
    if by == "acceleration":
        return "accelerates the tool"
    speed, turn = float(np.linalg.norm(column[:3])), float(np.linalg.norm(column[3:]))
    rise = math.degrees(rises(column[:3]))
    told = f"{speed:.2f} m/s"
    if speed > 1e-3:
        told += f", rises {rise:+.1f}°"
    return f"{told}, turns {turn:.2f} rad/s"
