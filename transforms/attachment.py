"""How a transform with an action map reads its environment's specs, and declares its own entries to TorchRL."""

from __future__ import annotations

from typing import Self

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform

from nht import ActionMap
from nht.transforms.action_spec import (
    find_actuation_spec,
    limits,
    transformed_action_spec,
    transformed_observation_spec,
)
from nht.transforms.context import check_context, check_writers, read_context
from nht.transforms.torchrl_internals import (
    EarlyReader,
    completes_the_environment,
    leaves,
    let_read_early,
    surroundings,
)


class Attachment(EarlyReader):
    """A transform with an action map: its keys, and what it knows about the environment around it.

    Attributes:
        map: the transform's own.
        context_keys: keys of the entries of the map's context; none if that is empty.
        action_key, actuation_key, context_key, executed_key, forward_only: as of ``ActionMapTransform``.
    """

    map: ActionMap
    context_keys: list[NestedKey]
    action_key: NestedKey
    actuation_key: NestedKey
    context_key: NestedKey
    executed_key: NestedKey
    forward_only: bool
    _low: Tensor | None
    _high: Tensor | None
    _executed_spec: Unbounded
    _context_shape: torch.Size
    _is_current = True

    def _register_limits(self) -> None:
        """Register the limits as buffers, not saved: they belong to the environment and are read on attaching."""
        self.register_buffer("_low", None, persistent=False)
        self.register_buffer("_high", None, persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        """The map's precision, which actions and context have, too."""
        return self.map.action_scale.dtype

    def clone(self) -> Self:
        """A transform with the same map, for another environment: it does not know this one's limits."""
        twin = super().clone()
        twin._low = twin._high = None
        return twin

    def empty_cache(self) -> None:
        """Called whenever the chain around the transform changes."""
        super().empty_cache()
        self._is_current = False

    def read_raw(self, observed: TensorDictBase) -> None:
        """Write the context to its key."""
        observed.set(self.context_key, read_context(observed, self.context_keys, self.dtype))

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach the transform to an environment, or to a Compose that may be attached to one already."""
        super().set_container(container)
        self._attach()

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Replace the environment's actuation by the policy's action."""
        self._attach()  # again, for transforms may have been inserted since
        actuation_spec = action_spec[self.actuation_key]
        del action_spec[self.actuation_key]
        action_spec[self.action_key] = Bounded(
            -1.0,
            1.0,
            shape=(*actuation_spec.shape[:-1], self.map.action_dim),
            dtype=self.dtype,
            device=actuation_spec.device,
        )
        return action_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Register what is added to the data: collectors drop what is not in the specs."""
        self._attach()
        executed_spec = self._executed_spec
        if (device := observation_spec.device) is not None:
            executed_spec = executed_spec.to(device)
        observation_spec[self.executed_key] = executed_spec.expand(
            *observation_spec.shape, *executed_spec.shape
        )
        return self._with_context(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Register the context as an input too: worker processes are sent nothing else along with the action."""
        return self._with_context(state_spec)

    def _with_context(self, spec: Composite) -> Composite:
        if self.context_keys:
            spec[self.context_key] = Unbounded(self._context_shape, dtype=self.dtype, device=spec.device)
        return spec

    def before_reset(self) -> None:
        """Read the chain again if it has changed."""
        self._check_place()

    def _check_place(self) -> None:
        """Read the chain again if it has changed; to be called before the environment is stepped."""
        if not self._is_current:
            self._attach()

    def _attach(self) -> None:
        """Check the map against the environment, if there is one by now, and read what holds for all steps."""
        self._is_current = True
        env, chain, ahead = surroundings(self)
        if env is None:
            return
        if self.forward_only:
            raise ValueError("a forward_only transform is for replay buffers, not for environments.")
        self._attach_actuation(env.base_env, ahead)
        raw_keys = set(env.base_env.full_observation_spec.keys(True, True))
        if taken := {self.context_key, self.executed_key} & raw_keys.union(*(t.out_keys for t in ahead)):
            raise ValueError(
                f"there is another entry {taken.pop()!r} already: choose another context_key or executed_key."
            )
        if self.context_keys:
            self._attach_context(env.base_env, chain, ahead, made=set(self.context_keys) - raw_keys)

    def _attach_actuation(self, base: EnvBase, ahead: list[Transform]) -> None:
        action_spec = transformed_action_spec(base, ahead)
        spec = find_actuation_spec(action_spec, self.actuation_key, self.map.actuation_dim)
        batch_dims = len(base.batch_size)
        self._low, self._high = limits(spec, batch_dims)
        self._context_shape = torch.Size((*spec.shape[:-1], self.map.context_dim))
        if self.actuation_key in base.full_action_spec.keys(True, True):
            spec = base.full_action_spec[self.actuation_key]  # what other transforms make of it is executed
        self._executed_spec = Unbounded(spec.shape[batch_dims:], dtype=spec.dtype, device=spec.device)

    def _attach_context(
        self, base: EnvBase, chain: Compose | None, ahead: list[Transform], made: set[NestedKey]
    ) -> None:
        """Decide where in the chain the context is read; ``made`` are the keys that other transforms make."""
        observation_spec = base.full_observation_spec
        if made and ahead:
            check_writers(ahead, self.context_keys, made)
            observation_spec = transformed_observation_spec(base, ahead)
        check_context(observation_spec, self.context_keys, self._context_shape[:-1], self.map.context_dim)
        self.reads_early = not made and not all(map(completes_the_environment, ahead))
        if self.reads_early and chain is not None:
            if self not in leaves(chain):
                raise ValueError(
                    "the ActionMapTransform is in a Compose with a _step or _reset of its own, which hides it from "
                    "the chain around it: put it in front of all transforms that may rewrite its context."
                )
            let_read_early(chain)
