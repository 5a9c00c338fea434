"""One action map for each of several learners, applied together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

import nht

FOR_TRAINING = ("seed", "lipschitz", "lipschitz_norm", "start", "beta_kl", "beta_dynamics")
"""Arguments of maps that have no effect after training."""

Group = tuple[list[int], nn.Module, dict[str, Tensor], dict[str, Tensor]]
"""Indices of maps of one shape, one of the maps, and their stacked parameters and buffers, each ``(maps, ...)``."""


class MapsSideBySide(nht.ActionMap):
    """Maps of equal widths, applied together: row l of the first dimension goes through map l.

    Maps of one class and the same arguments, but for those of their training, are one call; the same map for all is not
    even stacked.

    Args:
        maps: one for each learner, trained.

    Raises:
        ValueError: if they differ in width or in the observations that they see.
    """

    learns = False

    def __init__(self, maps: Sequence[nht.ActionMap]) -> None:
        first = maps[0]
        for place, map in enumerate(maps):
            for name in ("action_dim", "actuation_dim", "context_dim", "context_keys"):
                if getattr(map, name) != getattr(first, name):
                    raise ValueError(
                        f"learners of one population share {name}: the map of learner 0 has {getattr(first, name)}, "
                        f"that of learner {place} has {getattr(map, name)}."
                    )
        super().__init__(first.context_dim, first.actuation_dim, min(first.action_dim, first.actuation_dim))
        self.action_dim = first.action_dim  # with corrections beside the action, more than there are motors
        self.context_keys = first.context_keys
        self.maps = nn.ModuleList(maps)
        self._groups: list[Group] | None = None

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Actuations ``(L, *batch, n)`` of actions ``(L, *batch, k)`` in contexts ``(L, *batch, context_dim)``."""
        return self._each("forward", action, context)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Actions ``(L, *batch, k)`` of actuations ``(L, *batch, n)`` in contexts ``(L, *batch, context_dim)``."""
        return self._each("project", actuation, context)

    def decode(
        self, action: Tensor, context: Tensor, low: Tensor | None = None, high: Tensor | None = None
    ) -> Tensor:
        """What actions in [-1, 1]^k do, as ``nht.ActionMap.decode``; limits ``(n,)`` are those of all."""
        return self._each("decode", action, context, low, high)

    def encode(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The actions that stand for actuations, as ``nht.ActionMap.encode``."""
        return self._each("encode", actuation, context)

    def _apply(self, *args: Any, **kwargs: Any) -> MapsSideBySide:
        self._groups = None  # another device or precision
        super()._apply(*args, **kwargs)
        return self

    def _each(self, method: str, *rows: Any) -> Tensor:
        if self._groups is None:
            self._groups = grouped(list(self.maps))
        values, context, *limits = rows
        results: list[Tensor | None] = [None] * len(self.maps)
        for places, map, parameters, buffers in self._groups:
            whole = len(places) == len(self.maps)
            own = (values, context) if whole else (values[places], context[places])
            if parameters or buffers:
                call = _Method(map, method)
                part = vmap(lambda p, b, v, c, call=call: functional_call(call, (p, b), (v, c, *limits)))(
                    _of_member(parameters), _of_member(buffers), *own
                )
            else:
                part = getattr(map, method)(*own, *limits)
            if whole:
                return part
            for place, result in zip(places, part, strict=True):
                results[place] = result
        return torch.stack([result for result in results if result is not None])


class _Method(nn.Module):
    """A method of a map as the forward of a module, which is what can be called with other parameters."""

    def __init__(self, map: nn.Module, method: str) -> None:
        super().__init__()
        self.map, self._method = map, method

    def forward(self, *args: Any) -> Tensor:
        """Whatever the method returns."""
        result: Tensor = getattr(self.map, self._method)(*args)
        return result


def _of_member(values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"map.{name}": value for name, value in values.items()}


def grouped(maps: Sequence[nn.Module]) -> list[Group]:
    """Groups of maps of one shape; tensors that all maps of a group share are not stacked."""
    places: dict[str, list[int]] = {}
    for place, map in enumerate(maps):
        places.setdefault(_shape(map), []).append(place)
    groups: list[Group] = []
    for found in places.values():
        members = [maps[place] for place in found]
        if all(_same(members[0], member) for member in members[1:]):
            groups.append((found, members[0], {}, {}))
        else:
            groups.append((found, members[0], *stack_module_state(members)))
    return groups


def _shape(map: nn.Module) -> str:
    """A key that is equal for maps whose computations differ only in their numbers."""
    assert isinstance(map, nht.ActionMap)
    arguments = map.init_args()
    told = {name: value for name, value in arguments.items() if name not in (*FOR_TRAINING, "map")}
    inner = _shape(arguments["map"]) if "map" in arguments else ""
    shapes = {name: tuple(value.shape) for name, value in map.state_dict().items()}
    return f"{type(map).__module__}.{type(map).__qualname__} {told} {map.saturation} {shapes} {inner}"


def _same(one: nn.Module, other: nn.Module) -> bool:
    states = one.state_dict(), other.state_dict()
    return all(torch.equal(value, states[1][name]) for name, value in states[0].items())
