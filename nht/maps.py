"""The family's core: NHT, SVD and the raw interface."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.action_map import ActionMap
from nht.geometry import householder_apply, householder_coordinates, householder_frame, sphere_exp
from nht.linear_map import LinearActionMap, NormKind
from nht.networks import Activation, ContextNetwork

__all__ = ["NHT", "SVD", "ActionMap", "Identity", "LinearActionMap", "NormKind"]


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
