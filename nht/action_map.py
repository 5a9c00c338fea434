"""The base class of action maps: from a low-dimensional action and a context to the actuation, and back."""

from __future__ import annotations

import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import FunctionType
from typing import Any, ClassVar, cast, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from nht.arguments import named_arguments, positional_arguments, remembering_arguments
from nht.networks import check_choice
from nht.saturation import DEFAULT_SATURATION, Saturation, saturate
from nht.widths import checked_forward, checked_project

WRAPPED = "_nht_wrapped"


class ActionMap(nn.Module, ABC):
    """A fixed or learned map (action, context) -> actuation, and all that a policy's action means.

    Shapes: action (*batch, k), actuation (*batch, n), context (*batch, context_dim). A map that needs no
    context takes one all the same; its last dimension may then be 0. Tensors of another last dimension are refused by
    ``forward`` and ``project``, whatever class overrides them.

    ``forward`` and ``project`` are in the map's own, raw units. A policy's action lies in [-1, 1]^k: ``decode`` turns
    it into an actuation, ``encode`` does the reverse. Two settings belong to the map and are saved with it:
    ``action_scale``, what an action of 1 means in raw units, and ``saturation``, what happens at the motors' limits.

    Subclasses are trained, saved and loaded like the maps of this package: the base class remembers the constructor's
    arguments.

    Attributes:
        action_dim: k.
        actuation_dim: n.
        context_dim: width of the context.
        context_keys: keys of the entries that, concatenated in this order, are the context. None until trained.
        data_fingerprint: which demonstrations it was trained on. None until trained.
        action_scale: buffer, scalar: what a policy's 1 stands for. Training sets it to the largest |a_i| of the
            projected demonstrations, ``set_action_scale`` to anything else. 1 until then.
        actuation_low: buffer, (n,): the smallest demonstrated actuations. -infinity until trained.
        actuation_high: buffer, (n,): the largest ones. infinity until trained.
        learns: whether training changes what the map does, not only its bounds.
        needs_next_context: whether ``loss`` reads ("next", "context"), (batch, context_dim).
    """

    learns = True
    needs_next_context = False

    action_scale: Tensor
    actuation_low: Tensor
    actuation_high: Tensor
    _saturation: Saturation = "clip"  # of objects pickled before there was a choice
    _recorded_arguments: ClassVar[dict[str, Any]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Let every subclass remember its arguments and refuse wrong widths, whatever it overrides."""
        super().__init_subclass__(**kwargs)
        for name, wrap in (
            ("__init__", remembering_arguments),
            ("forward", checked_forward),
            ("project", checked_project),
        ):
            method = getattr(cls, name)
            if not getattr(method, "__isabstractmethod__", False) and not hasattr(method, WRAPPED):
                setattr(cls, name, _marked(wrap(method)))

    def __init__(self, context_dim: int, actuation_dim: int, action_dim: int) -> None:
        super().__init__()
        if not 1 <= action_dim <= actuation_dim:
            raise ValueError(f"action_dim must be in 1 ... actuation_dim={actuation_dim}, got {action_dim}.")
        if context_dim < 0:
            raise ValueError(f"context_dim must be 0 or more, got {context_dim}.")
        self.context_dim = operator.index(context_dim)
        self.actuation_dim = operator.index(actuation_dim)
        self.action_dim = operator.index(action_dim)
        self.context_keys: tuple[NestedKey, ...] | None = None
        self.data_fingerprint: str | None = None
        self.saturation = DEFAULT_SATURATION if action_dim < actuation_dim else "clip"
        self.register_buffer("action_scale", torch.ones(()))
        self.register_buffer("actuation_low", torch.full((self.actuation_dim,), -torch.inf))
        self.register_buffer("actuation_high", torch.full((self.actuation_dim,), torch.inf))

    def __setattr__(self, name: str, value: Any) -> None:
        """Let a subclass have a layer called like one of the methods below, as many autoencoders do.

        ``forward`` and ``project`` of the subclass then find the layer; the method is ``type(map).encode(map, ...)``.
        """
        super().__setattr__(name, value)
        if name in ("decode", "encode", "rest") and isinstance(value, nn.Module | nn.Parameter):
            self.__dict__[name] = value

    @property
    def saturation(self) -> Saturation:
        """What ``decode`` does at the motors' limits: ``"scale"`` or ``"clip"``, see ``nht.saturation``."""
        return self._saturation

    @saturation.setter
    def saturation(self, kind: Saturation) -> None:
        check_choice("saturation", kind, get_args(Saturation))
        self._saturation = kind

    @abstractmethod
    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Actuation, (*batch, n), of an action in the map's own units. Nothing is scaled or clipped here.

        Raises:
            ValueError: if the last dimension of action or context is not the map's.
        """

    @abstractmethod
    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The action, (*batch, k), in the map's own units, that stands for an actuation.

        Raises:
            ValueError: if the last dimension of actuation or context is not the map's.
        """

    def decode(
        self, action: Tensor, context: Tensor, low: Tensor | None = None, high: Tensor | None = None
    ) -> Tensor:
        """The actuation for a policy's action in [-1, 1]^k: ``self(action_scale * action, context)``, saturated.

        Args:
            action: (*batch, k). Entries beyond 1 are taken as they are.
            context: (*batch, context_dim).
            low: the smallest actuations that the motors take, (n,) or anything that broadcasts; None, or -infinity,
                where there is no limit.
            high: the largest ones, likewise.

        Returns:
            The actuation, (*batch, n), in the precision of the limits; without limits, in that of the map.

        Raises:
            ValueError: if the last dimension of action or context is not the map's.
        """
        scale = self.action_scale
        context = context.to(scale.dtype)
        actuation = self(action.to(scale.dtype) * scale, context)
        if low is None and high is None:
            return actuation
        rest = self.rest(context) if self._saturation == "scale" else None
        return saturate(actuation, low, high, kind=self._saturation, rest=rest)

    def encode(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The policy's action that stands for an actuation: ``project(actuation, context) / action_scale``.

        It is not clipped: demonstrations may go beyond [-1, 1]^k.

        Args:
            actuation: (*batch, n).
            context: (*batch, context_dim).

        Raises:
            ValueError: if the last dimension of actuation or context is not the map's.
        """
        scale = self.action_scale
        return self.project(actuation.to(scale.dtype), context.to(scale.dtype)) / scale

    def rest(self, context: Tensor) -> Tensor:
        """The actuation (*batch, n) from which ``saturation="scale"`` measures: zero.

        Affine maps return their offset u0(c). Nonlinear maps return zero, whatever they give for action 0.
        """
        return self.action_scale.new_zeros(*context.shape[:-1], self.actuation_dim)

    @torch.no_grad()
    def set_action_scale(self, value: float | Tensor) -> None:
        """Set what a policy's action of 1 stands for, in the map's own units.

        Raises:
            ValueError: unless it is a single number, positive and finite, in the map's precision too.
        """
        scale = torch.as_tensor(value).detach().to(self.action_scale)
        if scale.ndim or not 0 < float(scale) < math.inf:
            given = value.tolist() if isinstance(value, Tensor) else value
            raise ValueError(f"action_scale must be a positive, finite number, got {given}.")
        self.action_scale.copy_(scale)

    def _reconstruct(self, actuation: Tensor, context: Tensor) -> Tensor:
        """An actuation, (*batch, n), projected and mapped back."""
        return self(self.project(actuation, context), context)

    def loss(self, batch: TensorDictBase) -> Tensor:
        """What training minimises: the mean of |u - u_hat|^2, u_hat being u projected and mapped back.

        Args:
            batch: "context" (batch, context_dim) and "actuation" (batch, n); and ("next", "context") for a map
                that needs it.
        """
        actuation, context = batch["actuation"], batch["context"]
        return (actuation - self._reconstruct(actuation, context)).square().sum(-1).mean()

    def fit(self, batch: TensorDictBase) -> bool:
        """Prepare the map from all training data, before any gradient step.

        Returns:
            True if that was all the training it takes: a closed form.
        """
        return False

    def init_args(self) -> dict[str, Any]:
        """The constructor's arguments by name: they make an untrained twin, ``type(map)(**map.init_args())``.

        If the map has an attribute of the argument's name, that is the value, else what was given. Only numbers, text,
        None, lists and dictionaries of these, and other maps can stand in a file. What a constructor takes by position
        alone, ``init_positional`` gives.
        """
        return named_arguments(self, self._recorded_arguments)

    def init_positional(self) -> tuple[Any, ...]:
        """The arguments that can be given by position alone; () for a constructor without ``*args`` and ``/``."""
        return positional_arguments(self, self._recorded_arguments)

    @torch.no_grad()
    def take_over(self, map: ActionMap) -> None:
        """Copy what another map learned about its demonstrations, and its saturation, precision and device.

        For maps that wrap another map.
        """
        self.context_keys = map.context_keys
        self.data_fingerprint = map.data_fingerprint
        self.saturation = map.saturation
        self.to(map.action_scale)
        self.action_scale.copy_(map.action_scale)
        self.actuation_low.copy_(map.actuation_low)
        self.actuation_high.copy_(map.actuation_high)


def _marked(method: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a method so that no subclass wraps it again, and copy its code object: compilers count attempts by it."""
    function = cast(FunctionType, method)
    function.__code__ = function.__code__.replace()
    setattr(function, WRAPPED, True)
    return function
