"""The network from a context to the parameters of an action map: a multilayer perceptron with one or several heads."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, get_args

import torch
from torch import Tensor, nn

Activation = Literal["relu", "sigmoid", "tanh"]

ACTIVATION_SLOPES = {"relu": 1.0, "sigmoid": 0.25, "tanh": 1.0}  # the largest slope of each
FLATTEST = 0.1  # the normaliser takes no deviation for smaller than this share of the largest


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
        """Map (*batch, heads * input_dim) to (*batch, heads * output_dim)."""
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
        check_choice("activation", activation, get_args(Activation))
        if context_dim < 1 or any(width < 1 for width in hidden):
            raise ValueError(f"widths must be at least 1, got {context_dim=} and hidden={list(hidden)}.")
        if heads > 1 and not len(hidden):
            raise ValueError(
                "several heads need a hidden layer that they can have of their own, got hidden=[]."
            )
        self.activation = activation
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            widths = [context_dim + other_dim, *hidden]
            widths[-1] *= heads if len(hidden) else 1
            self.layers = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))
            if heads > 1:
                self.layers.append(Heads(heads, hidden[-1], output_dim // heads))
            else:
                self.layers.append(nn.Linear(widths[-1], output_dim))
        self.register_buffer("context_mean", torch.zeros(context_dim))
        self.register_buffer("context_std", torch.ones(context_dim))

    def forward(self, context: Tensor, *others: Tensor) -> Tensor:
        """Map (*batch, context_dim), and others (*batch, width), to (*batch, output_dim)."""
        value = (context - self.context_mean) / self.context_std
        if others:
            value = torch.cat([value, *others], dim=-1)
        for layer in self.layers[:-1]:
            value = getattr(torch, self.activation)(layer(value))
        return self.layers[-1](value)

    def linear(self, index: int) -> nn.Linear | Heads:
        """One of the layers, with its type."""
        layer = self.layers[index]
        assert isinstance(layer, nn.Linear | Heads)
        return layer

    @torch.no_grad()
    def normalise(self, context: Tensor) -> None:
        """Take mean and deviation from contexts (T, context_dim).

        Deviations much smaller than the largest are raised: what hardly moves in the demonstrations, a height
        over a table for example, would become the loudest input as soon as it moves more.
        """
        std = context.std(0, correction=0)
        floor = FLATTEST * std.max()
        self.context_mean.copy_(context.mean(0))
        self.context_std.copy_(std.clamp_min(floor) if floor > 0 else torch.ones_like(std))

    @torch.no_grad()
    def start_from_one_output(self, size: float, seed: int) -> None:
        """Let all contexts start from nearly the same output, normally distributed with deviation ``size``."""
        head = self.linear(-1)
        head.weight.mul_(0.1)
        head.bias.normal_(std=size, generator=torch.Generator().manual_seed(int(seed)))

    @torch.no_grad()
    def start_from(self, output: Tensor) -> None:
        """Give all contexts the same output, (output_dim,), to start training from."""
        head = self.linear(-1)
        head.weight.zero_()
        head.bias.copy_(output.view_as(head.bias))


def check_choice(name: str, given: str, allowed: Sequence[str]) -> None:
    """Raise ValueError unless what was given for the argument ``name`` is allowed."""
    if given not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {given!r}.")
