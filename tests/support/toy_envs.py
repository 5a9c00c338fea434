"""Small environments in plain torch, and what must hold of their data: here so that spawned processes import them."""

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from nht import NHT, ActionMap
from nht.transforms import ActionMapTransform

SCALE = 1.5
LIMIT = 0.8  # of each actuation, less than the scale: some are clipped
CONTEXT_KEYS = ["tool", "joint"]


class ToyArm(EnvBase):
    """Three joints that move as far as they are told. Copy i ends its episodes after 4 + i steps.

    Beside "joint" (3) and "tool" (2), which tests let other transforms rewrite, stand copies under "raw"; what the
    environment got for an actuation stands under "received".
    """

    def __init__(
        self,
        rows: tuple[int, ...] = (),
        *,
        dtype: torch.dtype = torch.float32,
        limit: float | None = LIMIT,
        key: NestedKey = "action",
        reuse_buffers: bool = False,
    ) -> None:
        super().__init__(batch_size=rows)
        self.rows, self.floats, self.key, self.reuse_buffers = rows, dtype, key, reuse_buffers
        raw = Composite(joint=self._unbounded(3), tool=self._unbounded(2), shape=rows)
        self.observation_spec = Composite(
            **raw.clone(),
            raw=raw,
            step=Unbounded((*rows, 1), dtype=torch.int64),
            received=self._unbounded(3),
            shape=rows,
        )
        free = self._unbounded(3)
        self.full_action_spec = nest(
            key, free if limit is None else Bounded(-limit, limit, free.shape, dtype=dtype)
        )
        self.reward_spec = self._unbounded(1)
        flags = ("done", "terminated", "truncated")
        self.full_done_spec = Composite(
            {flag: Binary(1, (*rows, 1), dtype=torch.bool) for flag in flags}, shape=rows
        )
        self.joint = torch.zeros(*rows, 3, dtype=dtype)
        self.step_count = torch.zeros(*rows, 1, dtype=torch.int64)
        self.length = 4 + torch.arange(self.step_count.numel()).view_as(self.step_count)
        self.generator = torch.Generator().manual_seed(0)

    def _unbounded(self, width: int) -> Unbounded:
        return Unbounded((*self.rows, width), dtype=self.floats)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = torch.ones_like(self.step_count, dtype=torch.bool)
        if tensordict is not None:
            mask = tensordict.get("_reset", mask).view_as(mask)
        start = torch.randn(self.joint.shape, generator=self.generator).to(self.floats)
        self.joint.copy_(torch.where(mask, start, self.joint))
        self.step_count = torch.where(mask, 0, self.step_count)
        return self._observe(torch.zeros_like(self.joint))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actuation = tensordict[self.key]
        assert actuation.dtype == self.floats
        self.joint += actuation
        self.step_count = self.step_count + 1
        over = self.step_count >= self.length
        flags = {"terminated": torch.zeros_like(over), "truncated": over, "done": over.clone()}
        return self._observe(actuation.clone()).update({"reward": actuation[..., :1].clone(), **flags})

    def _observe(self, received: Tensor) -> TensorDictBase:
        raw = {"joint": self.joint.clone(), "tool": self.joint[..., :2].cos()}
        rewritten = {
            "joint": self.joint if self.reuse_buffers else raw["joint"].clone(),
            "tool": raw["tool"].clone(),
        }
        return TensorDict({**rewritten, "raw": raw, "step": self.step_count, "received": received}, self.rows)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)


class ToyTeam(EnvBase):
    """Two agents, each with joints of its own: entries have a dimension between the batch's and the last."""

    def __init__(self, rows: tuple[int, ...] = ()) -> None:
        super().__init__(batch_size=rows)
        shape = (*rows, 2, 3)
        self.observation_spec = nest(("team", "joint"), Unbounded(shape), rows)
        self.full_action_spec = nest(("team", "motor"), Bounded(-1, 1, shape), rows)
        self.reward_spec = Unbounded((*rows, 1))

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        return self.full_observation_spec.rand()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return (
            self.full_observation_spec.rand()
            .update(self.full_reward_spec.rand())
            .update(self.full_done_spec.zero())
        )

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


def nest(key: NestedKey, spec: TensorSpec, rows: tuple[int, ...] | None = None) -> Composite:
    """A Composite with one entry."""
    rows = spec.shape[:-1] if rows is None else rows
    for name in reversed((key,) if isinstance(key, str) else key):
        spec = Composite({name: spec}, shape=rows)
    return spec


def toy_map(dtype: torch.dtype = torch.float32) -> ActionMap:
    """Clips at the limits, so that what is expected is written down at once."""
    map = NHT(context_dim=5, actuation_dim=3, action_dim=2, hidden=(8,)).to(dtype)
    map.saturation = "clip"
    return map


def toy_transform(**options) -> ActionMapTransform:
    return ActionMapTransform(toy_map(), CONTEXT_KEYS, action_scale=SCALE, **options)


def mapped_arm(rows: tuple[int, ...] = ()) -> EnvBase:
    return TransformedEnv(ToyArm(rows), toy_transform())


def assert_mapped(
    data: TensorDictBase, map: ActionMap | None = None, scale: float = SCALE, limit: float = LIMIT
):
    """Every step executed what the map makes of action and raw context; the data say so, before and after."""
    map = toy_map() if map is None else map
    for root in (data, data["next"]):
        context = torch.cat([root["raw", key] for key in CONTEXT_KEYS], -1)
        assert torch.equal(root["context"], context.to(root["context"].dtype))
        assert torch.equal(root["actuation"], root["received"])
    with torch.no_grad():
        expected = map(scale * data["action"], data["context"]).clamp(-limit, limit)
    torch.testing.assert_close(
        data["next", "actuation"], expected.to(data["actuation"].dtype), atol=1e-5, rtol=1e-5
    )
