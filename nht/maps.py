"""Action maps: from a low-dimensional action and a context to the actuation of the motors, and back."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from nht.geometry import (
    householder_apply,
    householder_coordinates,
    householder_frame,
    least_squares,
    sphere_exp,
)

Activation = Literal["relu", "sigmoid", "tanh"]
NormKind = Literal["spectral", "frobenius"]

ACTIVATION_SLOPES = {"relu": 1.0, "sigmoid": 0.25, "tanh": 1.0}  # the largest slope of each
FLATTEST = 0.1  # the normaliser takes no deviation for smaller than this share of the largest


class ActionMap(nn.Module, ABC):
    """A fixed or learned map (action, context) -> actuation.

    Shapes: action (*batch, k), actuation (*batch, n), context (*batch, context_dim). A map that needs no
    context takes one all the same; its last dimension may then be 0. A subclass that keeps its constructor's
    arguments as attributes of the same names is trained, saved and loaded like those below.

    Attributes:
        action_dim: k.
        actuation_dim: n.
        context_dim: width of the context.
        context_keys: the entries that, side by side in this order, are the context. None until trained.
        data_fingerprint: which demonstrations it was trained on. None until trained.
        action_scale: buffer, scalar: the largest |a_i| of the projected demonstrations. 1 until trained.
        actuation_low: buffer, (n,): the smallest demonstrated actuations. -infinity until trained.
        actuation_high: buffer, (n,): the largest ones. infinity until trained.
        learns: whether demonstrations decide what the map does, not only its bounds.
        needs_next_context: whether `loss` reads ("next", "context"), (batch, context_dim).
    """

    learns = True
    needs_next_context = False

    action_scale: Tensor
    actuation_low: Tensor
    actuation_high: Tensor

    def __init__(self, context_dim: int, actuation_dim: int, action_dim: int) -> None:
        super().__init__()
        if not 1 <= action_dim <= actuation_dim:
            raise ValueError(f"action_dim must be in 1 ... actuation_dim={actuation_dim}, got {action_dim}")
        if context_dim < 0:
            raise ValueError(f"context_dim must be 0 or more, got {context_dim}")
        self.context_dim = context_dim
        self.actuation_dim = actuation_dim
        self.action_dim = action_dim
        self.context_keys: tuple[NestedKey, ...] | None = None
        self.data_fingerprint: str | None = None
        self.register_buffer("action_scale", torch.ones(()))
        self.register_buffer("actuation_low", torch.full((actuation_dim,), -torch.inf))
        self.register_buffer("actuation_high", torch.full((actuation_dim,), torch.inf))

    @abstractmethod
    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Actuation, (*batch, n). Nothing is scaled or clipped here."""

    @abstractmethod
    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The action, (*batch, k), that stands for an actuation."""

    def loss(self, batch: TensorDictBase) -> Tensor:
        """What training minimises: the mean of |u - u_hat|^2, u_hat being u projected and mapped back.

        Args:
            batch: "context" (batch, context_dim) and "actuation" (batch, n); and ("next", "context") for a map
                that needs it.
        """
        actuation, context = batch["actuation"], batch["context"]
        return (actuation - self(self.project(actuation, context), context)).square().sum(-1).mean()

    def fit(self, batch: TensorDictBase) -> bool:
        """Prepares the map from all training data, before any gradient step.

        Returns:
            True if that was all the training it takes: a closed form.
        """
        return False

    def init_args(self) -> dict[str, Any]:
        """The constructor's arguments, JSON values or other maps: they make an untrained twin."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}


class LinearActionMap(ActionMap):
    """An action map that is linear in the action: u = Q(c) a.

    Attributes:
        network: what turns the context into a description of the basis; None if the basis is always the same.
        network_gain: a Lipschitz constant, in the spectral norm, from the network's output to the basis; without
            a network, from the context to the basis.
        lipschitz: the Lipschitz constant of Q(c) that training keeps to; None for no limit.
        lipschitz_norm: the norm of the layers' matrices that is limited to this end.
    """

    network: "ContextNetwork | None"

    def __init__(
        self,
        context_dim: int,
        actuation_dim: int,
        action_dim: int,
        lipschitz: float | None = None,
        lipschitz_norm: NormKind = "spectral",
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        if lipschitz is not None and not 0 < lipschitz < torch.inf:
            raise ValueError(f"lipschitz must be a positive number or None, got {lipschitz}")
        _check_choice("lipschitz_norm", lipschitz_norm, get_args(NormKind))
        self.network = None
        self.network_gain = 0.0
        self.lipschitz = lipschitz
        self.lipschitz_norm = lipschitz_norm

    @abstractmethod
    def basis(self, context: Tensor) -> Tensor:
        """Q(c): (*batch, context_dim) -> (*batch, n, k)."""

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Q(c) a."""
        return (self.basis(context) @ action.unsqueeze(-1)).squeeze(-1)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Least squares: the action whose actuation is nearest (Eq. 5)."""
        return least_squares(self.basis(context), actuation)


class Heads(nn.Module):
    """Linear layers side by side, each on its own share of the input: one layer with a block-diagonal matrix.

    Args:
        heads: number of layers.
        input_dim: width of each one's input.
        output_dim: width of each one's output.
    """

    def __init__(self, heads: int, input_dim: int, output_dim: int) -> None:
        super().__init__()
        layers = [nn.Linear(input_dim, output_dim) for _ in range(heads)]
        self.weight = nn.Parameter(torch.stack([layer.weight.detach() for layer in layers]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach() for layer in layers]))

    def forward(self, value: Tensor) -> Tensor:
        """Maps (*batch, heads * input_dim) to (*batch, heads * output_dim)."""
        shares = value.unflatten(-1, (len(self.weight), -1)).unsqueeze(-1)
        return ((self.weight @ shares).squeeze(-1) + self.bias).flatten(-2)


class ContextNetwork(nn.Module):
    """A multilayer perceptron on the context, which it normalises first: (c - mean) / std.

    It may have other inputs, which it takes as they are.

    Args:
        context_dim: width of the context.
        output_dim: width of the output.
        hidden: widths of the hidden layers; empty for a single linear layer.
        activation: after each hidden layer.
        seed: of the initial weights. The global random state is neither used nor changed.
        other_dim: width of the other inputs.
        heads: equal parts of the output, each of which gets a last hidden layer of its own.
    """

    context_mean: Tensor
    context_std: Tensor

    def __init__(
        self,
        context_dim: int,
        output_dim: int,
        hidden: Sequence[int],
        activation: Activation,
        seed: int,
        *,
        other_dim: int = 0,
        heads: int = 1,
    ) -> None:
        super().__init__()
        _check_choice("activation", activation, get_args(Activation))
        if context_dim < 1 or any(width < 1 for width in hidden):
            raise ValueError(f"widths must be at least 1, got {context_dim=} and hidden={list(hidden)}")
        if heads > 1 and not hidden:
            raise ValueError("several heads need a hidden layer that they can have of their own, got hidden=[]")
        self.activation = activation
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            widths = [context_dim + other_dim, *hidden]
            widths[-1] *= heads if hidden else 1
            self.layers = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))
            if heads > 1:
                self.layers.append(Heads(heads, hidden[-1], output_dim // heads))
            else:
                self.layers.append(nn.Linear(widths[-1], output_dim))
        self.register_buffer("context_mean", torch.zeros(context_dim))
        self.register_buffer("context_std", torch.ones(context_dim))

    def forward(self, context: Tensor, *others: Tensor) -> Tensor:
        """Maps (*batch, context_dim), and others (*batch, width), to (*batch, output_dim)."""
        value = (context - self.context_mean) / self.context_std
        if others:
            value = torch.cat([value, *others], dim=-1)
        for layer in self.layers[:-1]:
            value = getattr(torch, self.activation)(layer(value))
        return self.layers[-1](value)

    def linear(self, index: int) -> "nn.Linear | Heads":
        """One of the layers, with its type."""
        layer = self.layers[index]
        assert isinstance(layer, nn.Linear | Heads)
        return layer

    @torch.no_grad()
    def normalise(self, context: Tensor) -> None:
        """Takes mean and deviation from contexts (T, context_dim).

        Deviations much smaller than the largest are raised: what hardly moves in the demonstrations, a height
        over a table for example, would become the loudest input as soon as it moves more.
        """
        std = context.std(0, correction=0)
        floor = FLATTEST * std.max()
        self.context_mean.copy_(context.mean(0))
        self.context_std.copy_(std.clamp_min(floor) if floor > 0 else torch.ones_like(std))

    @torch.no_grad()
    def start_from_one_output(self, size: float, seed: int) -> None:
        """Lets all contexts start from nearly the same output, normally distributed with deviation `size`."""
        head = self.linear(-1)
        head.weight.mul_(0.1)
        head.bias.normal_(std=size, generator=torch.Generator().manual_seed(seed))


class NHT(LinearActionMap):
    """Neural Householder Transform (Eq. 13): orthonormal bases that change smoothly with the context.

    A network gives k tangent vectors, the exponential map makes them unit vectors, and the reflections at
    these, applied to the padded action, give Q(c) a.

    Args:
        context_dim: width of the context.
        actuation_dim: n, at least 2.
        action_dim: k, in 1 ... n.
        hidden: widths of the hidden layers.
        activation: "relu", "sigmoid" or "tanh".
        normalise: scale the entries of the context by their mean and deviation in the training data.
        lipschitz: Lipschitz constant of Q(c) that training keeps to, in the spectral norm and the raw
            context.
        lipschitz_norm: "spectral", or the stricter "frobenius", which the authors' code limits.
        multi_head: let each reflection have a last hidden layer of its own, of the same width, and its own output
            layer; the layers before are shared. Needs a hidden layer.
        seed: of the initial weights.

    Raises:
        ValueError: on an argument out of its range.
    """

    network: ContextNetwork

    def __init__(
        self,
        context_dim: int,
        actuation_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (256, 256),
        activation: Activation = "tanh",
        *,
        normalise: bool = False,
        lipschitz: float | None = None,
        lipschitz_norm: NormKind = "spectral",
        multi_head: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim, lipschitz, lipschitz_norm)
        if actuation_dim < 2:
            raise ValueError(f"NHT needs an actuation_dim of at least 2, got {actuation_dim}")
        self.hidden = tuple(hidden)
        self.activation = activation
        self.normalise = normalise
        self.multi_head = multi_head
        self.seed = seed
        tangents, heads = action_dim * (actuation_dim - 1), action_dim if multi_head else 1
        self.network = ContextNetwork(context_dim, tangents, hidden, activation, seed, heads=heads)
        # Tangents of length about 1. From tangents near 0, where all reflectors coincide, contexts can set out for
        # opposite sides of the sphere. The two parts then meet in a steep wall, which training cannot tear down:
        # such fits ended at 100 times the error of the others.
        self.network.start_from_one_output((actuation_dim - 1) ** -0.5, seed)
        self.network_gain = 2 * action_dim**0.5  # Theorem 1; the exponential map has the constant 1

    def reflectors(self, context: Tensor) -> Tensor:
        """The unit vectors v_1 ... v_k (Eq. 12): (*batch, context_dim) -> (*batch, k, n)."""
        tangents = self.network(context).unflatten(-1, (self.action_dim, self.actuation_dim - 1))
        return sphere_exp(tangents)

    def basis(self, context: Tensor) -> Tensor:
        """Q(c), with orthonormal columns. `forward` and `project` do without it."""
        return householder_frame(self.reflectors(context))

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Q(c) a, by k reflections of the padded action."""
        return householder_apply(self.reflectors(context), action)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Q(c)^T u, which is least squares for orthonormal columns."""
        return householder_coordinates(self.reflectors(context), actuation)[..., : self.action_dim]

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The mean of |u - Q Q^T u|^2 (Eq. 6), read off the last n - k coordinates of u."""
        coordinates = householder_coordinates(self.reflectors(batch["context"]), batch["actuation"])
        return coordinates[..., self.action_dim :].square().sum(-1).mean()

    def fit(self, batch: TensorDictBase) -> bool:
        """Sets the normaliser; the weights are left to gradient steps."""
        if self.normalise:
            self.network.normalise(batch["context"])
        return False


class SVD(LinearActionMap):
    """One basis for all contexts: the k leading right singular vectors of the demonstrated actuations.

    They are not centred before, because a = 0 must stay u = 0. Until trained, the basis is the first k axes.
    """

    frame: Tensor

    def __init__(self, actuation_dim: int, action_dim: int, context_dim: int = 0) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.register_buffer("frame", torch.eye(actuation_dim, action_dim))

    def basis(self, context: Tensor) -> Tensor:
        """The same for every context."""
        return self.frame.expand(*context.shape[:-1], -1, -1)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Q a."""
        return action @ self.frame.mT

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Q^T u, which is least squares for orthonormal columns."""
        return actuation @ self.frame

    @torch.no_grad()
    def fit(self, batch: TensorDictBase) -> bool:
        """The singular vectors, each with its largest entry positive, as their signs are arbitrary."""
        rows = torch.linalg.svd(batch["actuation"].double(), full_matrices=False).Vh[: self.action_dim]
        largest = rows.gather(1, rows.abs().argmax(1, keepdim=True))
        self.frame.copy_((rows * largest.sign()).mT)
        return True


class Identity(LinearActionMap):
    """The raw interface: the action is the actuation, k = n."""

    learns = False

    def __init__(self, actuation_dim: int, context_dim: int = 0) -> None:
        super().__init__(context_dim, actuation_dim, actuation_dim)

    def basis(self, context: Tensor) -> Tensor:
        """The identity matrix."""
        identity = torch.eye(self.actuation_dim, dtype=context.dtype, device=context.device)
        return identity.expand(*context.shape[:-1], -1, -1)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """The action itself."""
        return action

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The actuation itself."""
        return actuation

    def fit(self, batch: TensorDictBase) -> bool:
        """There is nothing to learn."""
        return True


def _check_choice(name: str, given: str, allowed: Sequence[str]) -> None:
    if given not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {given!r}")
