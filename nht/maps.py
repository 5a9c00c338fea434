"""Action maps: from a low-dimensional action and a context to the actuation of the motors, and back."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from nht.geometry import householder_apply, householder_coordinates, householder_frame, sphere_exp

Activation = Literal["relu", "sigmoid", "tanh"]
NormKind = Literal["spectral", "frobenius"]

ACTIVATION_SLOPES: dict[str, float] = {"relu": 1.0, "sigmoid": 0.25, "tanh": 1.0}  # their largest slopes


class ActionMap(nn.Module, ABC):
    """A fixed or learned map (action, context) -> actuation.

    Shapes: action (*batch, k), actuation (*batch, n), context (*batch, context_dim). A map that needs no context takes
    one all the same; its last dimension may be 0. A subclass whose constructor arguments are plain JSON values, and
    are given back by `init_args`, can be trained, saved and loaded like the ones here.

    Attributes:
        action_dim, actuation_dim, context_dim: k, n and the context's width.
        context_keys: the keys whose entries, concatenated in this order, are the context. None until trained.
        data_fingerprint: the demonstrations' fingerprint. None until trained.
        action_scale: buffer, scalar; the largest |a_i| of the demonstrations projected through the map. 1 until trained.
        actuation_low, actuation_high: buffers, (n,); range of the demonstrated actuations. Infinite until trained.
    """

    action_scale: Tensor
    actuation_low: Tensor
    actuation_high: Tensor

    def __init__(self, context_dim: int, actuation_dim: int, action_dim: int) -> None:
        super().__init__()
        if not 1 <= action_dim <= actuation_dim:
            raise ValueError(
                f"action_dim must be between 1 and actuation_dim, got action_dim={action_dim}, "
                f"actuation_dim={actuation_dim}"
            )
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

    @abstractmethod
    def init_args(self) -> dict[str, Any]:
        """The constructor's arguments, as JSON values: `type(self)(**self.init_args())` is an untrained twin."""

    def loss(self, batch: TensorDictBase) -> Tensor:
        """What training minimises: the mean over the batch of |u - u_hat|^2, u_hat being u projected and mapped back.

        Args:
            batch: "context" (batch, context_dim) and "actuation" (batch, n).
        """
        actuation, context = batch["actuation"], batch["context"]
        return (actuation - self(self.project(actuation, context), context)).square().sum(-1).mean()

    def fit(self, batch: TensorDictBase) -> bool:
        """Prepares the map from all training data, before the first gradient step.

        Returns:
            True if this was all the training it takes (a closed-form fit); False if gradient steps must follow.
        """
        return False


class LinearActionMap(ActionMap):
    """u = Q(c) a: linear in the action.

    Attributes:
        network: what turns the context into a description of the basis; None if the basis does not depend on it.
        network_gain: a Lipschitz constant, in the spectral norm, of the step from the network's output to the basis.
        lipschitz: the Lipschitz constant of Q(c) that training keeps to; None for no limit.
        lipschitz_norm: the matrix norm that training limits. "frobenius" is never smaller, hence stricter.
    """

    network: "ContextNetwork | None"
    network_gain: float

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
        return (self.basis(context) @ action.unsqueeze(-1)).squeeze(-1)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Least squares: the action whose actuation is nearest (Eq. 5)."""
        return torch.linalg.lstsq(self.basis(context), actuation.unsqueeze(-1)).solution.squeeze(-1)


class ContextNetwork(nn.Module):
    """A multilayer perceptron on the context, which it first normalises: (c - mean) / std.

    Args:
        hidden: widths of the hidden layers; empty for a single linear layer.
        seed: of the initial weights. The global random state is neither read nor changed.
    """

    context_mean: Tensor
    context_std: Tensor

    def __init__(
        self, context_dim: int, output_dim: int, hidden: Sequence[int], activation: Activation, seed: int
    ) -> None:
        super().__init__()
        _check_choice("activation", activation, get_args(Activation))
        if any(width < 1 for width in hidden):
            raise ValueError(f"every width in hidden must be at least 1, got {list(hidden)}")
        if context_dim < 1:
            raise ValueError(f"a network needs a context_dim of at least 1, got {context_dim}")
        self.activation = activation
        widths = [context_dim, *hidden, output_dim]
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            self.layers = nn.ModuleList(
                nn.Linear(*pair) for pair in zip(widths[:-1], widths[1:], strict=True)
            )
        self.register_buffer("context_mean", torch.zeros(context_dim))
        self.register_buffer("context_std", torch.ones(context_dim))

    def forward(self, context: Tensor) -> Tensor:
        value = (context - self.context_mean) / self.context_std
        for layer in self.layers[:-1]:
            value = getattr(torch, self.activation)(layer(value))
        return self.layers[-1](value)

    @torch.no_grad()
    def normalise_from(self, context: Tensor) -> None:
        """Takes mean and standard deviation from contexts (T, context_dim).

        An entry that varies by less than a hundredth of the most varied one is left at the scale of the latter's
        hundredth: what hardly moves in the demonstrations must not become the loudest input once it moves more.
        """
        std = context.std(0, correction=0)
        widest = std.max()
        self.context_mean.copy_(context.mean(0))
        self.context_std.copy_(std.clamp_min(widest / 100) if widest > 0 else torch.ones_like(std))


class NHT(LinearActionMap):
    """Neural Householder Transform (Eq. 13): orthonormal bases that vary smoothly with the context.

    A network gives k tangent vectors, the exponential map makes unit vectors of them, whose k reflections, applied to
    the padded action, are Q(c) a.

    Args:
        context_dim, actuation_dim, action_dim: context width, n and k.
        hidden: widths of the hidden layers.
        activation: "relu", "sigmoid" or "tanh".
        normalise: scale the contexts to mean 0 and deviation 1, as measured on the training data.
        lipschitz: Lipschitz constant of Q(c), in the spectral norm and the raw context, that training keeps to.
        lipschitz_norm: the norm of the layers that it limits; the authors' code took "frobenius".
        seed: of the initial weights.

    Raises:
        ValueError: on k outside 1 ... n, n < 2, or a value that is not among those named above.
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
        seed: int = 0,
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim, lipschitz, lipschitz_norm)
        if actuation_dim < 2:
            raise ValueError(f"NHT needs an actuation_dim of at least 2, got {actuation_dim}")
        self.hidden, self.activation, self.normalise, self.seed = tuple(hidden), activation, normalise, seed
        self.network = ContextNetwork(context_dim, action_dim * (actuation_dim - 1), hidden, activation, seed)
        self.network_gain = 2 * action_dim**0.5  # Theorem 1; the exponential map's own constant is 1

    def init_args(self) -> dict[str, Any]:
        return {
            "context_dim": self.context_dim,
            "actuation_dim": self.actuation_dim,
            "action_dim": self.action_dim,
            "hidden": list(self.hidden),
            "activation": self.activation,
            "normalise": self.normalise,
            "lipschitz": self.lipschitz,
            "lipschitz_norm": self.lipschitz_norm,
            "seed": self.seed,
        }

    def reflectors(self, context: Tensor) -> Tensor:
        """The unit vectors v_1 ... v_k (Eq. 12): (*batch, context_dim) -> (*batch, k, n)."""
        tangents = self.network(context).unflatten(-1, (self.action_dim, self.actuation_dim - 1))
        return sphere_exp(tangents)

    def basis(self, context: Tensor) -> Tensor:
        return householder_frame(self.reflectors(context))

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return householder_apply(self.reflectors(context), action)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Q^T u, which for orthonormal columns is the least-squares action."""
        return householder_coordinates(self.reflectors(context), actuation)[..., : self.action_dim]

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The mean of |u - Q Q^T u|^2 (Eq. 6), read off the last n - k coordinates of u in the frame Q."""
        coordinates = householder_coordinates(self.reflectors(batch["context"]), batch["actuation"])
        return coordinates[..., self.action_dim :].square().sum(-1).mean()

    def fit(self, batch: TensorDictBase) -> bool:
        if self.normalise:
            self.network.normalise_from(batch["context"])
        return False


class SVD(LinearActionMap):
    """One basis for all contexts: the k leading right singular vectors of the demonstrated actuations.

    The actuations are not centred, for a = 0 must stay u = 0. Until trained, the first k axes.
    """

    frame: Tensor

    def __init__(self, actuation_dim: int, action_dim: int, context_dim: int = 0) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.register_buffer("frame", torch.eye(actuation_dim, action_dim))

    def init_args(self) -> dict[str, Any]:
        return {
            "actuation_dim": self.actuation_dim,
            "action_dim": self.action_dim,
            "context_dim": self.context_dim,
        }

    def basis(self, context: Tensor) -> Tensor:
        return self.frame.expand(*context.shape[:-1], -1, -1)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return action @ self.frame.mT

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        return actuation @ self.frame

    @torch.no_grad()
    def fit(self, batch: TensorDictBase) -> bool:
        _, _, rows = torch.linalg.svd(batch["actuation"].double(), full_matrices=False)
        frame = rows[: self.action_dim].mT
        # A singular vector's sign is arbitrary: make its largest entry positive, so that machines agree.
        largest = frame.gather(0, frame.abs().argmax(0, keepdim=True))
        self.frame.copy_(frame * largest.sign())
        return True


class Identity(LinearActionMap):
    """The raw interface: the action is the actuation, k = n."""

    def __init__(self, actuation_dim: int, context_dim: int = 0) -> None:
        super().__init__(context_dim, actuation_dim, actuation_dim)

    def init_args(self) -> dict[str, Any]:
        return {"actuation_dim": self.actuation_dim, "context_dim": self.context_dim}

    def basis(self, context: Tensor) -> Tensor:
        identity = torch.eye(self.actuation_dim, dtype=context.dtype, device=context.device)
        return identity.expand(*context.shape[:-1], -1, -1)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return action

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        return actuation

    def fit(self, batch: TensorDictBase) -> bool:
        return True


def _check_choice(name: str, given: str, allowed: Sequence[str]) -> None:
    if given not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {given!r}")
