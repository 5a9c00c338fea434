"""Stacks networks of one shape into one network whose parameters have a leading dimension of learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


class StackedLinear(nn.Module):
    """Linear layers of several learners: one batched matrix product.

    Args:
        layers: of one shape.
    """

    def __init__(self, layers: Sequence[nn.Linear]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.stack([layer.weight.data for layer in layers]))  # (L, out, in)
        self.bias = nn.Parameter(torch.stack([layer.bias.data for layer in layers]))  # (L, out)

    def forward(self, inputs: Tensor) -> Tensor:
        """``(L, *batch, in)`` to ``(L, *batch, out)``."""
        rows = inputs.flatten(1, -2)
        if self.weight.shape[1] == 1:  # for which a matrix product takes twice as long
            product = (rows * self.weight).sum(-1, keepdim=True) + self.bias.unsqueeze(1)
        else:
            product = stacked_linear(rows, self.weight, self.bias)
        return product.view(*inputs.shape[:-1], -1)


class StackedLayerNorm(nn.Module):
    """Layer normalisation of several learners, over the last dimension.

    Args:
        layers: of one shape.
    """

    def __init__(self, layers: Sequence[nn.LayerNorm]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.stack([layer.weight.data for layer in layers]))  # (L, size)
        self.bias = nn.Parameter(torch.stack([layer.bias.data for layer in layers]))  # (L, size)

    def forward(self, inputs: Tensor) -> Tensor:
        """``(L, *batch, size)``, normalised."""
        return stacked_norm(inputs.flatten(1, -2), self.weight, self.bias).view(inputs.shape)


class StackedTanh(nn.Module):
    """tanh x as 2 sigmoid(2 x) - 1, to 2e-7 of 1: on a CPU half as dear as PyTorch's own, its gradient included.

    Of one learner, whose tensors are small, it would be twice as dear.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """The same shape."""
        output: Tensor = _SigmoidTanh.apply(inputs) if inputs.device.type == "cpu" else inputs.tanh()
        return output


class _SigmoidTanh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor) -> Tensor:
        output = inputs.mul(2).sigmoid_().mul_(2).sub_(1)
        ctx.save_for_backward(output)
        return output

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (output,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, output)


def stacked_linear(rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """``(L, B, in)`` by weights ``(L, out, in)`` and biases ``(L, out)``, to ``(L, B, out)``."""
    return torch.baddbmm(bias.unsqueeze(1), rows, weight.mT)


def stacked_norm(rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """``(L, B, size)`` normalised over its last dimension, then scaled and moved by ``(L, size)`` each."""
    normed = torch.nn.functional.layer_norm(rows, rows.shape[-1:])
    return torch.addcmul(bias.unsqueeze(1), normed, weight.unsqueeze(1))


def stacked(networks: Sequence[Network]) -> Network:
    """One network of the same class for all learners: its inputs ``(*batch, size)`` become ``(L, *batch, size)``.

    Its linear layers become ``StackedLinear``, its layer norms ``StackedLayerNorm``, tanh ``StackedTanh``; every other
    parameter and buffer gets a leading dimension. Names stay, so that ``of_learner`` gives the state of one of the
    networks.

    Args:
        networks: of one shape, one for each learner. Other modules with parameters of their own must be written for a
            leading dimension.

    Raises:
        ValueError: if their parameters are of different shapes; names the learner.
    """
    shapes = [{name: tuple(value.shape) for name, value in each.state_dict().items()} for each in networks]
    for place, found in enumerate(shapes):
        if found != shapes[0]:
            raise ValueError(
                f"learners of one population have networks of one shape: learner 0 has {shapes[0]}, "
                f"learner {place} has {found}."
            )
    result = deepcopy(networks[0])
    _stack_into(result, networks)
    return result


def _stack_into(result: nn.Module, networks: Sequence[nn.Module]) -> None:
    for name, value in result.named_parameters(recurse=False):
        values = [getattr(network, name).data for network in networks]
        setattr(result, name, nn.Parameter(torch.stack(values), requires_grad=value.requires_grad))
    for name, _ in result.named_buffers(recurse=False):
        setattr(result, name, torch.stack([getattr(network, name) for network in networks]))
    for name, child in result.named_children():
        children: list[Any] = [network.get_submodule(name) for network in networks]
        if isinstance(child, nn.Linear):
            setattr(result, name, StackedLinear(children))
        elif isinstance(child, nn.LayerNorm):
            setattr(result, name, StackedLayerNorm(children))
        elif isinstance(child, nn.Tanh):
            setattr(result, name, StackedTanh())
        else:
            _stack_into(child, children)


def of_learner(state: Mapping[str, Tensor], learner: int) -> dict[str, Tensor]:
    """The state of one learner's network, from that of a ``stacked`` one."""
    return {name: value[learner].clone() for name, value in state.items()}
