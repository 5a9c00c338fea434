"""The geometry of a serial arm, from which its kinematics follow."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Arm:
    """A serial arm with revolute joints: Denavit-Hartenberg parameters, joint by joint, in the standard convention.

    Attributes:
        lengths: a [m].
        twists: alpha [rad].
        offsets: d [m]; the last one reaches to the tool.
    """

    lengths: tuple[float, ...]
    twists: tuple[float, ...]
    offsets: tuple[float, ...]
