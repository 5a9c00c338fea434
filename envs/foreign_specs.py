"""Checks whether a foreign environment can be driven: it needs flat, continuous actions and numeric observations."""

from __future__ import annotations

import torch
from torchrl.data import Bounded, TensorSpec, Unbounded
from torchrl.envs import EnvBase

PRECISIONS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
NO_OBSERVATIONS = ("success", "failure", "diverged", "step_count")


def check_specs(env: EnvBase, name: str) -> None:
    """Check the specs of one copy.

    Args:
        env: TorchRL's wrapper.
        name: of the environment, for the message.

    Raises:
        ValueError: if the copy is a batch, if its action is discrete, nested or no vector, or if an observation is an
            image, discrete or nested.
    """
    if env.batch_size:
        raise ValueError(
            f"{name} has the batch size {tuple(env.batch_size)}, expected one copy, of batch size ()."
        )
    _check_action(env, name)
    entries = dict(env.observation_spec.items(True, True))
    if not entries:
        raise ValueError(f"{name} observes nothing.")
    for key, spec in entries.items():
        if key not in NO_OBSERVATIONS:
            _check_observation(key, spec, name)


def _check_action(env: EnvBase, name: str) -> None:
    entries = dict(env.full_action_spec.items(True, True))
    if list(entries) != ["action"]:
        raise ValueError(f"{name} has the actions {list(entries)}, expected one, 'action'.")
    spec = entries["action"]
    if not isinstance(spec, Bounded | Unbounded) or spec.dtype not in PRECISIONS:
        raise ValueError(
            f"{name} has discrete actions ({_described(spec)}): only continuous ones can be driven."
        )
    if len(spec.shape) != 1:
        raise ValueError(f"{name} has actions of shape {tuple(spec.shape)}, expected a vector, (n,).")


def _check_observation(key: object, spec: TensorSpec, name: str) -> None:
    if not isinstance(key, str):
        raise ValueError(f"{name} has the nested observation {key}: only those of one level are known.")
    if spec.dtype == torch.uint8 and len(spec.shape) > 1:
        raise ValueError(
            f"{name} observes an image, {key!r} ({_described(spec)}): only vectors of numbers can be seen."
        )
    if spec.dtype not in PRECISIONS:
        raise ValueError(
            f"{name} has the discrete observation {key!r} ({_described(spec)}): only continuous ones can be seen."
        )


def _described(spec: TensorSpec) -> str:
    return f"{type(spec).__name__} of shape {tuple(spec.shape)}, {str(spec.dtype).removeprefix('torch.')}"
