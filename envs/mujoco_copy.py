"""Saves and draws the MuJoCo simulators of other libraries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from nht.envs.rendering import MujocoRenderer

# Of the model: large, and the same in all episodes.
FIXED = ("bvh_", "mesh_", "skin_", "tex_")
# Of the data: as long as there are contacts, or the inside of a solver that starts anew in every step.
FLEETING = ("efc_", "iefc_", "efm_", "iacc", "ifrc_", "island_", "map_", "bvh_", "flex", "plugin", "contact")
INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


class Simulator:
    """A ``mujoco.MjModel`` and its ``MjData``, whoever steps them.

    Args:
        model: which a task may change when an episode starts.
        data: of the model.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model = model
        self.data = data

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step depends on.

        ``"state"`` is what MuJoCo's own step reads. ``"derived"`` is what it left behind, poses, forces and sensors:
        after a step these belong to its last substep, and tasks read them before they take the next one.
        """
        state = np.empty(mujoco.mj_stateSize(self.model, INTEGRATION))
        mujoco.mj_getState(self.model, self.data, state, INTEGRATION)
        model = {name: values.copy() for name, values in self._model_arrays().items()}
        derived = np.concatenate([values.ravel() for values in self._derived()])
        return {"state": state, "model": model, "derived": derived}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned.

        Raises:
            ValueError: if it is of another model, or of a MuJoCo version with another state.
        """
        for name, values in self._model_arrays().items():
            values[...] = saved["model"][name]
        mujoco.mj_setState(self.model, self.data, saved["state"], INTEGRATION)
        # dm_control's steps start from positions and velocities that were propagated already.
        mujoco.mj_step1(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, saved["state"], INTEGRATION)
        if "derived" in saved:  # older files lack it
            self._load_derived(np.asarray(saved["derived"]))

    def _load_derived(self, saved: NDArray[np.float64]) -> None:
        arrays = self._derived()
        expected = sum(values.size for values in arrays)
        if saved.shape != (expected,):
            raise ValueError(
                f"the saved simulator has {saved.size} derived numbers, this one {expected}: it was saved from another "
                "model, or by another version of MuJoCo."
            )
        start = 0
        for values in arrays:
            values[...] = saved[start : start + values.size].reshape(values.shape)
            start += values.size

    def _derived(self) -> list[NDArray[np.float64]]:
        arrays = (
            getattr(self.data, name)
            for name in sorted(dir(self.data))
            if not name.startswith(("_", *FLEETING))
        )
        return [values for values in arrays if isinstance(values, np.ndarray) and values.dtype == np.float64]

    def _model_arrays(self) -> dict[str, NDArray[np.floating[Any]]]:
        """The arrays of the model that a task may change when an episode starts: positions, sizes, gains ..."""
        arrays = {name: getattr(self.model, name) for name in dir(self.model) if not name.startswith(FIXED)}
        return {
            name: values
            for name, values in arrays.items()
            if isinstance(values, np.ndarray) and np.issubdtype(values.dtype, np.floating)
        }

    def renderer(self, width: int, height: int, camera: str | int | None) -> MujocoRenderer:
        """Takes pictures through a camera of the model; None is the first one, or where there is none the free one."""
        from nht.envs.rendering import MujocoRenderer

        return MujocoRenderer(self.model, self.data, width, height, camera)
