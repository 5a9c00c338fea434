"""Compiles MuJoCo models, and checks states for them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from nht.envs.arrays import Array
from nht.envs.mujoco_log import warnings_logged

ASSETS = Path(__file__).parent / "assets"


def load_model(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file.

    Raises:
        ValueError: if it does not compile: the file's name, and MuJoCo's message.
    """
    return compile_model(str(path), lambda: mujoco.MjModel.from_xml_path(str(path)))


def compile_model(name: str, build: Callable[[], mujoco.MjModel]) -> mujoco.MjModel:
    """The model that ``build`` compiles.

    MuJoCo's warnings go to the log as information: whoever loads a model has not written it.

    Raises:
        ValueError: if it does not compile: the name, and MuJoCo's message.
    """
    try:
        with warnings_logged(logging.INFO, others=True):
            return build()
    except ValueError as error:
        raise ValueError(f"{name} does not compile: {str(error).removesuffix('.')}.") from error


def check_state(model: mujoco.MjModel, qpos: Array, qvel: Array, copies: int, tolerance: float) -> None:
    """Check that states from outside are valid for a model.

    Args:
        model: the model.
        qpos: positions, expected to be ``(copies, nq)`` [m, rad].
        qvel: velocities, expected to be ``(copies, nv)`` [m/s, rad/s].
        copies: how many states there must be.
        tolerance: how far beyond its limits a joint may stand [m, rad].

    Raises:
        ValueError: for another shape, a number that is not finite or a joint beyond its limits.
    """
    for name, given, size in (("qpos", qpos, model.nq), ("qvel", qvel, model.nv)):
        if given.shape != (copies, size):
            raise ValueError(f"expected {name} of shape {(copies, size)}, got {given.shape}.")
        if not np.isfinite(given).all():
            raise ValueError(f"{name} must be finite: row {np.argwhere(~np.isfinite(given))[0, 0]} is not.")
    _check_limits(model, qpos, tolerance)


def _check_limits(model: mujoco.MjModel, qpos: Array, tolerance: float) -> None:
    limited = np.flatnonzero(model.jnt_limited)
    angle = qpos[:, model.jnt_qposadr[limited]]
    low, high = model.jnt_range[limited].T
    beyond = np.maximum(low - angle, angle - high)
    if beyond.size and beyond.max() > tolerance:
        row, joint = np.unravel_index(beyond.argmax(), beyond.shape)
        raise ValueError(
            f"joint {model.joint(limited[joint]).name!r} stands at {angle[row, joint]:.4g} in row {row}, more than "
            f"{tolerance} beyond its limits [{low[joint]:.4g}, {high[joint]:.4g}]."
        )
