"""TorchRL's side of a batched task: ``BatchedMujocoEnv``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from nht.envs.task import BatchedTask


class BatchedMujocoEnv(EnvBase):
    """A TorchRL environment of batch size ``[N]`` whose N copies one native call steps together.

    Reads ``"action"`` ``(N, n)``, the actuation; writes the task's observations (float32), ``"reward"`` and the
    flags ``"done"``, ``"terminated"``, ``"truncated"``, ``"success"``, ``"failure"`` and ``"diverged"``, each
    ``(N, 1)``. Partial resets touch only the rows that ``"_reset"`` names.

    Args:
        task: the copies to step.
        device: where the tensors go; the physics stays on the CPU.
    """

    def __init__(self, task: BatchedTask, device: torch.device | str = "cpu") -> None:
        super().__init__(device=device, batch_size=[task.num_envs])
        self.task = task
        self._make_specs()

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
        self.reward_spec = self._reward_spec()
        self.done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")}, shape=batch
        )

    def _reward_spec(self) -> Bounded | Unbounded:
        low, high = self.task.reward_range
        shape = (*self.batch_size, 1)
        if math.isinf(low) or math.isinf(high):
            return Unbounded(shape, dtype=torch.float32, device=self.device)
        return Bounded(low, high, shape, dtype=torch.float32, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        rows = None
        if tensordict is not None and (mask := tensordict.get("_reset", None)) is not None:
            rows = np.flatnonzero(mask.view(-1).cpu().numpy())
        self.task.reset(rows)
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        names = ("done", "terminated", "truncated", "success", "failure", "diverged")
        return self._pack(self._observations() | {name: off.clone() for name in names})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actuation = tensordict.get("action").detach()
        outcome = self.task.step(actuation.to("cpu", torch.float64).numpy())
        flags = {
            "done": outcome.terminated | outcome.truncated,
            "terminated": outcome.terminated,
            "truncated": outcome.truncated,
            "success": outcome.success,
            "failure": outcome.failure,
            "diverged": outcome.diverged,
        }
        entries = {name: self._tensor(values[:, None]) for name, values in flags.items()}
        reward = self._tensor(outcome.reward[:, None].astype(np.float32))
        return self._pack(self._observations() | entries | {"reward": reward})

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # TorchRL would look for missing flags and wrong shapes: `_step` writes all of them, and right.
        return next_tensordict_out

    def _observations(self) -> dict[str, torch.Tensor]:
        return {key: self._tensor(values.astype(np.float32)) for key, values in self.task.observe().items()}

    def _tensor(self, values: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device)

    def _pack(self, entries: dict[str, torch.Tensor]) -> TensorDict:
        # Shapes and devices are ours: checking them again would cost more than the packing.
        return TensorDict._new_unsafe(entries, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.task.seed(seed)

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Release the native threads. A second call does nothing."""
        self.task.close()
        super().close(raise_if_closed=raise_if_closed)
