"""Demonstrations: whole episodes in a TorchRL replay buffer, beside a manifest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from numpy.typing import ArrayLike
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, TensorStorage

from nht.arrays import as_tensor
from nht.episodes import listed, whole_episodes
from nht.manifest import manifest_of
from nht.reading import shortened


class Demos:
    """Immutable demonstrations, made by ``save_demos``, ``load_demos`` or one of the methods ``from_...``.

    Attributes:
        buffer: replay buffer over all transitions, ``buffer.sample(256)``; nothing can be added to it.
        manifest: env, seed, expert, settings; keys with shapes and types; episodes, transitions; versions;
            fingerprint.
    """

    def __init__(self, buffer: ReplayBuffer, manifest: Mapping[str, Any]) -> None:
        self.buffer = buffer
        self.manifest = dict(manifest)

    @classmethod
    def from_tensors(
        cls,
        *,
        actuation: Tensor | ArrayLike,
        episode: Tensor | ArrayLike,
        context: Tensor | ArrayLike | Mapping[str, Tensor | ArrayLike],
        next_context: Tensor | ArrayLike | Mapping[str, Tensor | ArrayLike] | None = None,
        env: str = "unknown",
    ) -> Demos:
        """Demonstrations from tensors or NumPy arrays of your own, copied into memory.

        Args:
            actuation: (T, n), in order of time.
            episode: (T,), integers; the rows of an episode stand together.
            context: (T, context_dim), to be found under "context"; or several such tensors by key.
            next_context: the same, one step later, to be found under "next"; some maps need it.
            env: a name for where they come from.

        Raises:
            ValueError: on data that are no whole, finite demonstrations.
        """
        entries: dict[str, Any] = _named(context, "context")
        if next_context is not None:
            entries["next"] = _named(next_context, "next_context")
        entries["actuation"] = motors = as_tensor(actuation, "actuation")
        entries["episode"] = as_tensor(episode, "episode").long()
        return cls.from_episodes(TensorDict(entries, batch_size=motors.shape[:1]), env=env)

    @classmethod
    def from_tensordict(
        cls,
        data: TensorDictBase,
        *,
        actuation_key: NestedKey = "action",
        context: Mapping[str, NestedKey] | Sequence[NestedKey] = ("observation",),
        episode_key: NestedKey | None = None,
        done_key: NestedKey | None = None,
        env: str = "unknown",
    ) -> Demos:
        """Demonstrations from what TorchRL rolled out, collected or stored: ``dataset[:]`` of any of its data sets.

        Where episodes end is found from ids of trajectories and flags; episodes that do not end are left out, and
        their number is in the manifest under "settings".

        Args:
            data: (T,), or (N, T) with a trajectory in each row; in order of time, outcomes under "next".
            actuation_key: (*batch, n), what the motors got.
            context: keys that may serve as context, or such keys by the names they get: ``{"goal": ("info",
                "goal")}``; those that also stand under "next" are taken along.
            episode_key: integers that differ between episodes, where they are not "episode" or those of a
                collector.
            done_key: true at an episode's last step, where it is not "done", "terminated" or "truncated".
            env: a name for where they come from.

        Raises:
            KeyError: on a key that is not in the data; the message lists those that are.
            ValueError: if nothing says where episodes end, or on values that are not finite.
        """
        episodes, left_out = whole_episodes(
            data,
            actuation_key=actuation_key,
            context=context,
            episode_key=episode_key,
            done_key=done_key,
        )
        return cls.from_episodes(episodes, env=env, settings={"left_out_episodes": left_out})

    @classmethod
    def from_episodes(
        cls,
        data: TensorDictBase,
        *,
        env: str = "unknown",
        expert: str = "unknown",
        settings: Mapping[str, Any] | None = None,
    ) -> Demos:
        """Demonstrations from a TensorDict as ``save_demos`` takes it, copied into memory.

        Raises:
            KeyError: if "actuation" or "episode" is missing.
            ValueError: on data that are no whole, finite demonstrations.
        """
        manifest = manifest_of(data, env=env, seed=None, expert=expert, settings=dict(settings or {}))
        return cls(immutable_buffer(data.cpu().clone()), manifest)

    @property
    def data(self) -> TensorDictBase:
        """All transitions, (T,), in order of time."""
        return self.buffer.storage[: len(self)]

    @property
    def actuation(self) -> Tensor:
        """Demonstrated actuations, (T, n)."""
        return self.data["actuation"]

    @property
    def episode(self) -> Tensor:
        """The episode that each transition belongs to, (T,) int64."""
        return self.data["episode"]

    @property
    def fingerprint(self) -> str:
        """SHA-256 over keys, types, shapes and values."""
        return self.manifest["fingerprint"]

    def __len__(self) -> int:
        return len(self.buffer)

    def __repr__(self) -> str:
        about = self.manifest
        keys = ", ".join(f"{key} {tuple(value['shape'])}" for key, value in about["keys"].items())
        return (
            f"Demos({len(self):,} transitions in {about['episodes']:,} episodes, env={about['env']!r}, "
            f"expert={about['expert']!r}, keys: {shortened(keys, 400)})"
        )

    def context(self, keys: Sequence[NestedKey]) -> Tensor:
        """The entries of ``keys`` side by side, (T, context_dim); no keys give (T, 0).

        Raises:
            KeyError: on a key that is not there.
            ValueError: on an entry that is not one row of floats per transition.
        """
        data = self.data
        for key in keys:
            value = data.get(key, None)
            if not isinstance(value, Tensor):
                raise KeyError(
                    f"context key {key!r} is not in the demonstrations, which have {listed(data)}."
                )
            if value.ndim != 2 or not value.is_floating_point():
                raise ValueError(
                    f"context key {key!r} must hold floats (T, width), got {value.dtype} {tuple(value.shape)}."
                )
        return torch.cat([self.actuation[:, :0], *(data[key] for key in keys)], dim=-1)


def immutable_buffer(data: TensorDictBase) -> ReplayBuffer:
    """A buffer over ``data``, not copied, that takes no more."""
    return ReplayBuffer(storage=TensorStorage(data), writer=ImmutableDatasetWriter())


def _named(values: Any, name: str) -> dict[str, Tensor]:
    """The arrays of a context, by key; a single array gets the key "context"."""
    given = values if isinstance(values, Mapping) else {"context": values}
    return {key: as_tensor(value, f"{name}, key {key!r}") for key, value in given.items()}
