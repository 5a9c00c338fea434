"""SCL, the state-conditioned linear map: a basis without structure, to compare with orthonormal ones (A.4)."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from torch import Tensor

from nht.geometry import least_squares
from nht.maps import LinearActionMap, NormKind
from nht.networks import Activation, ContextNetwork
from nht.offset import ConstantOffset, NetworkOffset, OffsetKind, trained_offset


class SCL(LinearActionMap):
    """State-conditioned linear map: a network gives the entries of the basis (A.4).

    Actuations are projected by the pseudo-inverse, damped at the level of rounding. Nothing limits the norm of the
    basis, and the loss (Eq. 6) does not depend on it: it may grow in training, and with it the actuation that an action
    of 1 stands for. ``lipschitz`` limits how fast the basis changes, not how long its columns are.

    The network's output is the basis, entry by entry. Its Euclidean norm is the Frobenius norm of the basis, which is
    no smaller than the spectral one: from output to basis the Lipschitz constant is 1.

    Args:
        context_dim: width of the context.
        actuation_dim: n.
        action_dim: k, in 1 ... n.
        hidden: widths of the hidden layers.
        activation: "relu", "sigmoid" or "tanh".
        normalise: scale the entries of the context by their mean and deviation in the training data.
        lipschitz: Lipschitz constant of Q(c) that training keeps to, in the spectral norm and the raw
            context.
        lipschitz_norm: which norm of the layers' matrices is limited for it, "spectral" or "frobenius".
        offset: "none" for u0 = 0; "constant", trained from the mean of the demonstrations on; "contextual", from a
            network of its own, of the same widths, which keeps to ``lipschitz`` too. Then u = u0(c) + Q(c) a.
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
        offset: OffsetKind = "none",
        seed: int = 0,
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim, lipschitz, lipschitz_norm)
        self.hidden = tuple(hidden)
        self.activation = activation
        self.normalise = normalise
        self.offset = offset
        self.seed = seed
        self.network = ContextNetwork(context_dim, actuation_dim * action_dim, hidden, activation, seed)
        self.network.start_from_one_output(actuation_dim**-0.5, seed)  # columns of length about 1
        self.network_gain = 1.0
        self.offset_model = trained_offset(offset, context_dim, actuation_dim, hidden, activation, seed)

    def basis(self, context: Tensor) -> Tensor:
        """Q(c), any n x k matrix."""
        return self.network(context).unflatten(-1, (self.actuation_dim, self.action_dim))

    def _reconstruct(self, actuation: Tensor, context: Tensor) -> Tensor:
        """u0(c) + Q(c) Q(c)^+ (u - u0(c)), with the basis computed once."""
        if type(self) is not SCL:  # a subclass may go another way, there or back
            return super()._reconstruct(actuation, context)
        basis = self.basis(context)
        action = least_squares(basis, self.to_rest(actuation, context))
        return self.from_rest((basis @ action.unsqueeze(-1)).squeeze(-1), context)

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The mean of |u - Q Q^+ u|^2 (Eq. 6), u measured from u0(c)."""
        return self.losses(batch).mean()

    def losses(self, batch: TensorDictBase) -> Tensor:
        """The loss of each transition, (batch,).

        At the least-squares action the loss does not change with the action (envelope theorem). So the action counts
        as a constant in the gradient, and no derivative of an inverse is ever taken.
        """
        context, basis = batch["context"], self.basis(batch["context"])
        way = self.to_rest(batch["actuation"], context)
        action = least_squares(basis, way).detach()
        missed = way - (basis @ action.unsqueeze(-1)).squeeze(-1)
        return missed.square().sum(-1) + self.offset_losses(way)

    def fit(self, batch: TensorDictBase) -> bool:
        """Set the normaliser and where u0 starts; the weights are left to gradient steps."""
        if self.normalise:
            self.network.normalise(batch["context"])
        untrained = self.data_fingerprint is None
        if untrained and isinstance(self.offset_model, ConstantOffset | NetworkOffset):
            self.offset_model.fit(batch["context"], batch["actuation"], normalise=self.normalise)
        return False
