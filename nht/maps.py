"""The family's core: NHT, SVD and the raw interface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.action_map import ActionMap
from nht.geometry import (
    householder_apply,
    householder_coordinates,
    householder_frame,
    principal_directions,
    spanning_reflectors,
    sphere_exp,
    sphere_log,
)
from nht.linear_map import LinearActionMap, NormKind
from nht.networks import Activation, ContextNetwork, check_choice
from nht.offset import ConstantOffset, LinearOffset, NetworkOffset, OffsetKind, check_offset, trained_offset

__all__ = ["NHT", "SVD", "ActionMap", "Identity", "LinearActionMap", "NormKind"]


class NHT(LinearActionMap):
    """Neural Householder Transform (Eq. 13): orthonormal bases that change smoothly with the context.

    A network gives k tangent vectors, the exponential map makes them unit vectors, and the reflections at
    these, applied to the padded action, give Q(c) a.

    With an offset the map is affine, u0(c) + Q(c) a, for robots that do not rest at zero.

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
        offset: "none" for u0 = 0; "constant", trained from the mean of the demonstrations on; "contextual", from a
            network of its own, of the same widths, which keeps to ``lipschitz`` too.
        start: where training starts: "svd", from the plane that SVD finds in the training data, the same for all
            contexts; or "random". With "svd", a strict Lipschitz limit ends at SVD's plane, not at an arbitrary one.
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
        offset: OffsetKind = "none",
        start: Literal["svd", "random"] = "svd",
        seed: int = 0,
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim, lipschitz, lipschitz_norm)
        if actuation_dim < 2:
            raise ValueError(f"NHT needs an actuation_dim of at least 2, got {actuation_dim}.")
        check_choice("start", start, ("svd", "random"))
        self.hidden = tuple(hidden)
        self.activation = activation
        self.normalise = normalise
        self.multi_head = multi_head
        self.offset = offset
        self.start = start
        self.seed = seed
        tangents, heads = action_dim * (actuation_dim - 1), action_dim if multi_head else 1
        self.network = ContextNetwork(context_dim, tangents, hidden, activation, seed, heads=heads)
        # Tangents of length about 1. From tangents near 0, where all reflectors coincide, contexts can set out for
        # opposite sides of the sphere. The two parts then meet in a steep wall, which training cannot tear down:
        # such fits ended at 100 times the error of the others.
        self.network.start_from_one_output((actuation_dim - 1) ** -0.5, seed)
        self.network_gain = 2 * action_dim**0.5  # Theorem 1; the exponential map has the constant 1
        self.offset_model = trained_offset(offset, context_dim, actuation_dim, hidden, activation, seed)

    def reflectors(self, context: Tensor) -> Tensor:
        """The unit vectors v_1 ... v_k (Eq. 12): (*batch, context_dim) -> (*batch, k, n)."""
        tangents = self.network(context).unflatten(-1, (self.action_dim, self.actuation_dim - 1))
        return sphere_exp(tangents)

    def basis(self, context: Tensor) -> Tensor:
        """Q(c), with orthonormal columns. ``forward`` and ``project`` do without it."""
        return householder_frame(self.reflectors(context))

    def basis_norm(self) -> float:
        """1: the columns are orthonormal."""
        return 1.0

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """u0(c) + Q(c) a, by k reflections of the padded action."""
        return self.from_rest(householder_apply(self.reflectors(context), action), context)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Q(c)^T (u - u0(c)), which is least squares for orthonormal columns."""
        way = self.to_rest(actuation, context)
        return householder_coordinates(self.reflectors(context), way)[..., : self.action_dim]

    def _reconstruct(self, actuation: Tensor, context: Tensor) -> Tensor:
        """u0(c) + Q(c) Q(c)^T (u - u0(c)), with the reflectors computed once."""
        if type(self) is not NHT:  # a subclass may go another way, there or back
            return super()._reconstruct(actuation, context)
        reflectors = self.reflectors(context)
        action = householder_coordinates(reflectors, self.to_rest(actuation, context))[..., : self.action_dim]
        return self.from_rest(householder_apply(reflectors, action), context)

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The mean of |u - Q Q^T u|^2 (Eq. 6), u measured from u0(c)."""
        return self.losses(batch).mean()

    def losses(self, batch: TensorDictBase) -> Tensor:
        """The loss of each transition, (batch,), read off the last n - k coordinates of u."""
        way = self.to_rest(batch["actuation"], batch["context"])
        coordinates = householder_coordinates(self.reflectors(batch["context"]), way)
        return coordinates[..., self.action_dim :].square().sum(-1) + self.offset_losses(way)

    @torch.no_grad()
    def fit(self, batch: TensorDictBase) -> bool:
        """Set the normaliser and the weights to start from; gradient steps do the rest.

        A map that was trained before keeps its weights.
        """
        context, actuation = batch["context"], batch["actuation"]
        if self.normalise:
            self.network.normalise(context)
        if self.data_fingerprint is not None:
            return False
        if isinstance(self.offset_model, ConstantOffset | NetworkOffset):
            self.offset_model.fit(context, actuation, normalise=self.normalise)
        if self.start == "svd":
            frame = principal_directions(self.to_rest(actuation, context), self.action_dim)
            self.network.start_from(sphere_log(spanning_reflectors(frame)))
        return False


class SVD(LinearActionMap):
    """One basis for all contexts: the k leading right singular vectors of the demonstrated actuations.

    Without an offset the actuations are not centred first, because a = 0 must stay u = 0. Until trained, the basis is
    the first k axes.

    Args:
        actuation_dim: n.
        action_dim: k, in 1 ... n.
        context_dim: width of the context.
        offset: "none" for u0 = 0; "constant" for the mean actuation; "contextual" for u0(c) = A c + b. Least squares
            gives u0, the singular vectors of the residuals the basis: no other pair has a smaller error, because this
            u0 leaves the least outside the span of any basis. NHT has offsets that are not linear.
    """

    frame: Tensor

    def __init__(
        self, actuation_dim: int, action_dim: int, context_dim: int = 0, offset: OffsetKind = "none"
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        check_offset(offset, context_dim)
        self.offset = offset
        self.register_buffer("frame", torch.eye(actuation_dim, action_dim))
        if offset == "constant":
            self.offset_model = ConstantOffset(actuation_dim)
        elif offset == "contextual":
            self.offset_model = LinearOffset(context_dim, actuation_dim)

    def basis(self, context: Tensor) -> Tensor:
        """The basis, which is the same for every context."""
        return self.frame.expand(*context.shape[:-1], -1, -1)

    @torch.no_grad()
    def basis_norm(self) -> float:
        """The spectral norm of the basis."""
        return float(torch.linalg.matrix_norm(self.frame.double(), ord=2))

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """u0(c) + Q a."""
        return self.from_rest(action @ self.frame.mT, context)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Q^T (u - u0(c)), which is least squares for orthonormal columns."""
        return self.to_rest(actuation, context) @ self.frame

    @torch.no_grad()
    def fit(self, batch: TensorDictBase) -> bool:
        """The offset, then the singular vectors, each with its largest entry positive, as their signs are arbitrary."""
        way = batch["actuation"]
        if isinstance(self.offset_model, ConstantOffset | LinearOffset):
            self.offset_model.fit(batch["context"], way)
            way = self.to_rest(way, batch["context"])
        self.frame.copy_(principal_directions(way, self.action_dim))
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

    def basis_norm(self) -> float:
        """1: that of the identity matrix."""
        return 1.0

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """The action itself."""
        return action

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The actuation itself."""
        return actuation

    def fit(self, batch: TensorDictBase) -> bool:
        """There is nothing to learn."""
        return True
