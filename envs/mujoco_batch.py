"""TorchRL's side of a batched task: ``BatchedMujocoEnv``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded

from nht.envs.arrays import Rows
from nht.envs.pictures import Pictures, check_mode
from nht.envs.simulation import DEFAULT_SIZE
from nht.envs.task import BatchedTask
from nht.envs.torchrl_internals import WholeSteps, packed


class BatchedMujocoEnv(WholeSteps):
    """A TorchRL environment of batch size ``[N]`` whose N copies one native call steps together.

    With ``groups``, its batch size is ``[groups, N / groups]``; below, N stands for both.

    Reads ``"action"`` ``(N, n)``, the actuation; writes the task's observations (float32), ``"reward"`` and the flags
    ``"done"``, ``"terminated"``, ``"truncated"``, ``"success"``, ``"failure"`` and ``"diverged"``, each ``(N, 1)``.
    Partial resets touch only the rows that ``"_reset"`` names, partial steps only those that ``"_step"`` names: the
    others return the same observation again, with the reward 0.

    It can be copied and pickled, so that instances can be handed to the workers of collectors; pictures are taken anew.

    The reward's spec has no bounds, for transforms such as ``RewardSum`` take it for that of what they make of rewards:
    ``task.reward_range`` has them.

    Args:
        task: the copies to step.
        device: where the tensors go; the physics stays on the CPU.
        groups: of equal numbers of copies, as those of several learners; None has no dimension for it.
    """

    def __init__(
        self, task: BatchedTask, device: torch.device | str = "cpu", *, groups: int | None = None
    ) -> None:
        copies = [task.num_envs] if groups is None else [groups, task.num_envs // groups]
        super().__init__(device=device, batch_size=copies)
        self.task = task
        self._make_specs()
        self._pictures = Pictures(task)

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.device
        low, high = (torch.tensor(bound, dtype=torch.float32) for bound in self.task.actuation_bounds)
        self.action_spec = Bounded(low.expand(*batch, -1), high.expand(*batch, -1), device=device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
        observations = {
            key: Unbounded((*batch, size), dtype=torch.float32, device=device)
            for key, size in self.task.observation_sizes.items()
        }
        flags = {name: flag.clone() for name in ("success", "failure", "diverged")}
        self.observation_spec = Composite({**observations, **flags}, shape=batch)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float32, device=device)
        self.done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")}, shape=batch
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        rows = None
        if tensordict is not None and (mask := tensordict.get("_reset", None)) is not None:
            rows = _rows(mask)
        self.task.reset(rows)
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        names = ("done", "terminated", "truncated", "success", "failure", "diverged")
        return self._pack(self._observations() | {name: off.clone() for name in names})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actuation = tensordict.get("action").detach()
        mask = tensordict.get("_step", None)
        rows = None if mask is None or mask.all() else _rows(mask)
        flat = actuation.reshape(-1, actuation.shape[-1])
        outcome = self.task.step(flat.to("cpu", torch.float64).numpy(), rows)
        flags = {
            "done": outcome.terminated | outcome.truncated,
            "terminated": outcome.terminated,
            "truncated": outcome.truncated,
            "success": outcome.success,
            "failure": outcome.failure,
            "diverged": outcome.diverged,
        }
        columns = {name: values[:, None] for name, values in flags.items()}
        rewards = {"reward": outcome.reward[:, None]}
        return self._pack(self._moved(self.task.observe() | rewards, np.float32) | self._moved(columns, bool))

    def _observations(self) -> dict[str, torch.Tensor]:
        return self._moved(self.task.observe(), np.float32)

    def _moved(self, values: Mapping[str, NDArray[Any]], dtype: type) -> dict[str, torch.Tensor]:
        """Arrays ``(N, size)`` as tensors on the device; to a GPU all of them are one transfer."""
        device, batch = self.device, self.batch_size
        if device is None or device.type == "cpu":
            return {
                name: torch.from_numpy(each.astype(dtype)).view(*batch, -1) for name, each in values.items()
            }
        whole = torch.from_numpy(np.concatenate([*values.values()], axis=1).astype(dtype)).to(device)
        parts = whole.view(*batch, -1).split([each.shape[1] for each in values.values()], dim=-1)
        return dict(zip(values, parts, strict=True))

    def _pack(self, entries: dict[str, torch.Tensor]) -> TensorDict:
        # Shapes and devices are ours: checking them again would cost more than the packing.
        return packed(entries, self.batch_size, self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            groups = self.batch_size[0]
            of_groups = np.random.SeedSequence(seed).generate_state(groups).tolist()
            self.task.seed(seed if len(self.batch_size) == 1 else of_groups)

    def render(
        self,
        mode: str = "rgb_array",
        width: int = DEFAULT_SIZE[0],
        height: int = DEFAULT_SIZE[1],
        camera: str | int | None = None,
    ) -> NDArray[np.uint8]:
        """A picture of every copy as it stands now, ``(N, height, width, 3)``: what ``PixelRenderTransform`` asks for.

        Args:
            mode: ``"rgb_array"``, as other environments call it.
            width: of a picture [pixel].
            height: of a picture [pixel].
            camera: name or number of a camera of the model; None is the first one.

        Raises:
            RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
            ValueError: for another mode, or if the model has no such camera.
        """
        check_mode(mode)
        return self._pictures.take(width, height, camera)

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Release renderers and native threads. A second call does nothing."""
        self._pictures.close()
        self.task.close()
        super().close(raise_if_closed=raise_if_closed)


def _rows(mask: torch.Tensor) -> Rows:
    """The indices of the copies that a mask ``(N,)`` or ``(N, 1)`` names."""
    return np.flatnonzero(mask.view(-1).cpu().numpy())
