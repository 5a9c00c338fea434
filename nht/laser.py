"""Latent action models: conditional autoencoders, plain and as in LASER (Allshire et al., 2021)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.maps import ActionMap
from nht.networks import Activation, ContextNetwork

LOG_VARIANCE_RANGE = (-20.0, 20.0)  # of a latent, clamped: exp of what is far outside would overflow


class CAE(ActionMap):
    """Conditional autoencoder: the action is a latent, u = decoder(latent, context).

    It is trained on reconstruction alone. Nothing gives the latents a scale or a centre: take the action box from the
    demonstrations, as ActionMapTransform does by default, where an action of 1 is ``action_scale``, the largest
    |latent| that they have. No motion, u = 0, need not be the latent 0.

    Args:
        context_dim: width of the context.
        actuation_dim: n.
        action_dim: k, the width of the latent, in 1 ... n.
        hidden: widths of the hidden layers of encoder and decoder.
        activation: "relu", "sigmoid" or "tanh".
        normalise: scale the entries of the context by their mean and deviation in the training data.
        seed: of the initial weights.

    Attributes:
        encoder: (context, actuation) -> what describes the latent; its first k outputs are the latent itself.
        decoder: (context, latent) -> actuation.

    Raises:
        ValueError: on an argument out of its range.
    """

    outputs_per_latent = 1  # of the encoder

    def __init__(
        self,
        context_dim: int,
        actuation_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (256, 256),
        activation: Activation = "tanh",
        *,
        normalise: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.hidden = tuple(hidden)
        self.activation = activation
        self.normalise = normalise
        self.seed = seed
        self.encoder = self._network(self.outputs_per_latent * action_dim, actuation_dim, 0)
        self.decoder = self._network(actuation_dim, action_dim, 1)

    def _network(self, output_dim: int, other_dim: int, index: int) -> ContextNetwork:
        """One of up to three networks, each with a seed of its own."""
        seed = 3 * self.seed + index
        return ContextNetwork(
            self.context_dim, output_dim, self.hidden, self.activation, seed, other_dim=other_dim
        )

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """The decoded latent."""
        return self.decoder(context, action)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The encoder's latent, which is the mean where the encoder gives a Gaussian."""
        return self.encoder(context, actuation)[..., : self.action_dim]

    def fit(self, batch: TensorDictBase) -> bool:
        """Set the normalisers; the weights are left to gradient steps."""
        if self.normalise:
            for network in self.children():
                assert isinstance(network, ContextNetwork)
                network.normalise(batch["context"])
        return False


class LASER(CAE):
    """Latent action space for efficient RL: a variational CAE whose latents also predict the next context (Eq. 3).

        loss = |u - u_hat|^2 + beta_kl KL(N(mean, variance) || N(0, 1)) + beta_dynamics |d - d_hat|^2 / mean |d|^2

    with the latent drawn from N(mean, variance), which the encoder gives, and d = c' - c, the change of context in a
    step, normalised as the context is. The dynamics term is 1 for a prediction that nothing changes.

    What an action means: with beta_kl > 0 the demonstrations' latents are drawn towards a standard normal
    distribution, so 1 is its standard deviation and a box of +-2 or +-3 holds nearly all latents that the decoder was
    trained on. ActionMapTransform multiplies by ``action_scale``: by default the largest |mean| of the demonstrations.

    Args:
        context_dim: width of the context.
        actuation_dim: n.
        action_dim: k, the width of the latent, in 1 ... n.
        hidden: widths of the hidden layers of encoder, decoder and latent dynamics.
        activation: "relu", "sigmoid" or "tanh".
        beta_kl: weight of the KL divergence.
        beta_dynamics: weight of the dynamics term; 0 goes without, and then demonstrations need no next context.
        normalise: scale the entries of the context by their mean and deviation in the training data.
        seed: of the initial weights and of the noise.

    Attributes:
        dynamics: (context, latent) -> change of context, in units of its mean length; None if beta_dynamics is 0.
        noise: generator of the latents' noise. Not saved: a loaded map starts it anew.

    Raises:
        ValueError: on an argument out of its range.
    """

    outputs_per_latent = 2  # mean, log-variance
    change_length: Tensor

    def __init__(
        self,
        context_dim: int,
        actuation_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (256, 256),
        activation: Activation = "tanh",
        *,
        beta_kl: float = 1e-3,
        beta_dynamics: float = 1e-3,
        normalise: bool = False,
        seed: int = 0,
    ) -> None:
        for name, weight in (("beta_kl", beta_kl), ("beta_dynamics", beta_dynamics)):
            if not 0 <= weight < math.inf:
                raise ValueError(f"{name} must be a number of 0 or more, got {weight}.")
        super().__init__(
            context_dim, actuation_dim, action_dim, hidden, activation, normalise=normalise, seed=seed
        )
        self.beta_kl = beta_kl
        self.beta_dynamics = beta_dynamics
        self.needs_next_context = beta_dynamics > 0
        self.dynamics = self._network(context_dim, action_dim, 2) if self.needs_next_context else None
        self.register_buffer("change_length", torch.ones(()))
        self.noise = torch.Generator().manual_seed(int(seed))

    def latent(self, actuation: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of the latent's Gaussian: (*batch, n), (*batch, context_dim) -> twice (*batch, k)."""
        mean, log_variance = self.encoder(context, actuation).chunk(2, dim=-1)
        return mean, log_variance.clamp(*LOG_VARIANCE_RANGE)

    def next_context(self, action: Tensor, context: Tensor) -> Tensor:
        """The context that is predicted to follow, (*batch, context_dim), raw.

        Raises:
            ValueError: if beta_dynamics is 0.
        """
        if self.dynamics is None:
            raise ValueError("this LASER has beta_dynamics=0, and so no latent dynamics.")
        return context + self._change_unit() * self.dynamics(context, action)

    def loss(self, batch: TensorDictBase) -> Tensor:
        """Eq. 3, with a latent drawn anew at each call (reparametrised)."""
        actuation, context = batch["actuation"], batch["context"]
        mean, log_variance = self.latent(actuation, context)
        noise = torch.randn(mean.shape, generator=self.noise, dtype=mean.dtype).to(mean.device)
        action = mean + (log_variance / 2).exp() * noise
        loss = (actuation - self(action, context)).square().sum(-1).mean()
        divergence = (mean.square() + log_variance.exp() - log_variance - 1).sum(-1).mean() / 2
        loss = loss + self.beta_kl * divergence
        if self.dynamics is None:
            return loss
        change = (batch["next", "context"] - context) / self._change_unit()
        return loss + self.beta_dynamics * (change - self.dynamics(context, action)).square().sum(-1).mean()

    @torch.no_grad()
    def fit(self, batch: TensorDictBase) -> bool:
        """Set the normalisers and the mean length of a change; the weights are left to gradient steps."""
        super().fit(batch)
        if self.dynamics is not None:
            change = (batch["next", "context"] - batch["context"]) / self.dynamics.context_std
            length = change.square().sum(-1).mean().sqrt()
            self.change_length.copy_(length if length > 0 else torch.ones_like(length))
        return False

    def _change_unit(self) -> Tensor:
        """The change of the raw context that an output of 1 of the dynamics stands for, (context_dim,)."""
        assert self.dynamics is not None
        return self.change_length * self.dynamics.context_std
