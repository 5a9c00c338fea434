"""The simulator behind one ``DMControlEnv``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchrl.envs import EnvBase

from nht.envs.dm_control_internals import SuiteClock
from nht.envs.foreign_copies import ForeignCopy
from nht.envs.mujoco_copy import Simulator
from nht.envs.torchrl_internals import wrapped

if TYPE_CHECKING:
    from nht.envs.rendering import MujocoRenderer


class SuiteCopy(ForeignCopy):
    """A task of dm_control's suite.

    Args:
        env: TorchRL's ``DMControlEnv``.
    """

    def __init__(self, env: EnvBase) -> None:
        self._env = wrapped(env)
        self._clock = SuiteClock(self._env)
        self.simulator = Simulator(self._env.physics.model.ptr, self._env.physics.data.ptr)
        self.time_per_step = self._env.control_timestep()
        self.max_episode_steps = self._clock.limit
        # Alone in the suite lqr's rewards have no such bounds.
        if type(self._env.task).__module__ != "dm_control.suite.lqr":
            self.reward_range = (0.0, 1.0)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step and the next reset depend on."""
        progress = {
            "random": self._env.task.random.get_state(legacy=False),
            "steps": self._clock.steps,
            "ended": self._clock.ended,
        }
        return self.simulator.state_dict() | {"progress": progress}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        self.simulator.load_state_dict(saved)
        progress = saved["progress"]
        self._env.task.random.set_state(progress["random"])
        self._clock.steps = progress["steps"]
        self._clock.ended = progress["ended"]

    def renderer(self, width: int, height: int, camera: str | int | None) -> MujocoRenderer:
        """Takes pictures of this size through a camera of the model."""
        return self.simulator.renderer(width, height, camera)
