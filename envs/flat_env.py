"""One copy of another library's environment: flat observations in float32, and the flags that ours have."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import (
    CatTensors,
    Compose,
    DTypeCastTransform,
    FlattenObservation,
    StepCounter,
    Transform,
    UnsqueezeTransform,
)

from nht.envs.foreign_copies import ForeignCopy, longest
from nht.envs.foreign_specs import check_specs
from nht.envs.outcome import INFO_FLAGS

UNSEEN = ("step_count",)
"""Keys that are no observations: TorchRL's own clock."""


def flattened(make: Callable[[], EnvBase], simulator: Callable[[EnvBase], ForeignCopy], name: str) -> FlatEnv:
    """A copy with flat observations in float32, and the flags that all our environments have.

    Args:
        make: builds the copy, TorchRL's wrapper of batch size ``[]``.
        simulator: finds the simulator in what ``make`` built.
        name: of the environment, for messages.

    Raises:
        ValueError: for observations or actions that are not flat numbers.
    """
    env = make()
    check_specs(env, name)
    copy = simulator(env)
    aside = {*INFO_FLAGS, *UNSEEN, *copy.aside}
    keys = [key for key in env.observation_spec if key not in aside]
    shapes = {key: env.observation_spec[key].shape for key in (*keys, *copy.aside)}
    transforms: list[Transform] = [
        _as_vector(key, len(shape)) for key, shape in shapes.items() if len(shape) != 1
    ]
    specs = [*env.observation_spec.values(), env.full_reward_spec[env.reward_key], env.action_spec]
    # In this order always, whatever a set's is.
    for precision in sorted({spec.dtype for spec in specs if spec.dtype.is_floating_point}, key=str):
        if precision != torch.float32:
            transforms.append(DTypeCastTransform(precision, torch.float32))
    if keys != ["observation"]:
        transforms.append(CatTensors(keys, "observation", del_keys=False, sort=False))
    if math.isinf(copy.max_episode_steps):
        transforms.append(StepCounter(longest(copy)))
    flat = FlatEnv(env, Compose(*transforms, OutcomeFlags()))
    flat.copy_of = copy
    return flat


class FlatEnv(TransformedEnv):
    """One copy of an environment, as ``ForeignEnv`` steps it."""

    copy_of: ForeignCopy
    """Its simulator."""


def _as_vector(key: str, dimensions: int) -> Transform:
    if dimensions == 0:
        return UnsqueezeTransform(-1, in_keys=[key], allow_positive_dim=True)
    return FlattenObservation(first_dim=0, last_dim=-1, in_keys=[key], allow_positive_dim=True)


class OutcomeFlags(Transform):
    """Adds the flags that all our environments have and this one lacks; they are never set."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        unset = torch.zeros(*next_tensordict.batch_size, 1, dtype=torch.bool, device=next_tensordict.device)
        for name in INFO_FLAGS:
            if name not in next_tensordict:
                next_tensordict[name] = unset.clone()
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Register the flags: collectors drop what is not in the specs."""
        shape = (*observation_spec.shape, 1)
        for name in INFO_FLAGS:
            if name not in list(observation_spec.keys()):
                observation_spec[name] = Binary(
                    n=1, shape=shape, dtype=torch.bool, device=observation_spec.device
                )
        return observation_spec
