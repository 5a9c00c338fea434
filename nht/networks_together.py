"""Networks of several maps, each on rows of its own: what they give, and their gradients, in few calls.

Rows of all maps stand one behind another. A layer is a matrix product for each network, of the very shape that it has
alone; all else, activations and their slopes, is one call for all networks of one depth and activation. So nothing is
padded, whatever the widths and batch sizes, and no network sees another's numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from nht.networks import ContextNetwork
from nht.offset import ConstantOffset

BACKWARD: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "relu": lambda gradient, value: gradient.mul_(value.sign()),
    "sigmoid": lambda gradient, value: gradient.mul_(1 - value).mul_(value),
    "tanh": lambda gradient, value: gradient.mul_(
        torch.addcmul(torch.ones_like(value), value, value, value=-1)
    ),
}
"""From the gradient of what an activation gave, and what it gave, to the gradient of its input, in place.

Rounded as autograd rounds it: 1 - y^2 in one operation, for one.
"""


class NetworksTogether:
    """Several context networks, of any widths, depths and activations, with one linear layer after another.

    Weights and gradients are the networks' own: ``backward`` writes to ``parameter.grad``, which must be there.

    Args:
        networks: of one input and output width, on one device.
        rows: how many rows belong to each.
    """

    def __init__(self, networks: Sequence[ContextNetwork], rows: Sequence[int]) -> None:
        like = networks[0].context_mean
        count, width = sum(rows), networks[0].linear(-1).bias.numel()
        self._mean = torch.cat(
            [net.context_mean.expand(n, -1) for net, n in zip(networks, rows, strict=True)]
        )
        self._std = torch.cat([net.context_std.expand(n, -1) for net, n in zip(networks, rows, strict=True)])
        self._inputs = like.new_empty(count, len(like))
        self._output, self._gradient = like.new_empty(count, width), like.new_empty(count, width)
        alike: dict[tuple[int, str], list[int]] = {}
        for place, network in enumerate(networks):
            alike.setdefault((len(network.layers), network.activation), []).append(place)
        shares = [values.split(list(rows)) for values in (self._inputs, self._output, self._gradient)]
        self._stacks = [
            _Stack(
                [networks[place] for place in places],
                *([share[place] for place in places] for share in shares),
            )
            for places in alike.values()
        ]

    @torch.no_grad()
    def forward(self, context: Tensor) -> Tensor:
        """Map contexts (rows, context_dim) to outputs (rows, output_dim), in memory that the next call writes again."""
        torch.sub(context, self._mean, out=self._inputs).div_(self._std)
        for stack in self._stacks:
            stack.forward()
        return self._output

    @torch.no_grad()
    def backward(self, gradient: Tensor) -> None:
        """From the gradient of the last outputs, (rows, output_dim), to those of all weights."""
        self._gradient.copy_(gradient)
        for stack in self._stacks:
            stack.backward()


class ConstantsTogether:
    """Constant offsets of several maps, to what calls them like ``NetworksTogether``."""

    def __init__(self, offsets: Sequence[ConstantOffset], rows: Sequence[int]) -> None:
        self._values = [offset.value.detach() for offset in offsets]
        self._gradients = [offset.value.grad for offset in offsets]
        self._rows = list(rows)

    @torch.no_grad()
    def forward(self, context: Tensor) -> Tensor:
        """The offset of each row, (rows, n)."""
        return torch.cat([value.expand(n, -1) for value, n in zip(self._values, self._rows, strict=True)])

    @torch.no_grad()
    def backward(self, gradient: Tensor) -> None:
        """From the gradient of the last outputs, (rows, n), to those of all offsets."""
        for share, own in zip(gradient.split(self._rows), self._gradients, strict=True):
            torch.sum(share, 0, out=own)


class _Stack:
    """Networks of one depth and activation. All memory is laid out once, and so are the calls.

    Args:
        networks: the networks.
        inputs: where the rows of each stand.
        outputs: where what each gives is to stand.
        gradients: where the gradient of that will stand.
    """

    def __init__(
        self,
        networks: Sequence[ContextNetwork],
        inputs: Sequence[Tensor],
        outputs: Sequence[Tensor],
        gradients: Sequence[Tensor],
    ) -> None:
        self._activate_ = getattr(torch, f"{networks[0].activation}_")  # in place
        self._backward_ = BACKWARD[networks[0].activation]
        self._hidden: list[Tensor] = []  # of every layer the values of all networks, one behind another
        self._hidden_gradients: list[Tensor] = []
        values, pulls = [inputs], [inputs]  # of each layer a matrix a network; inputs need no gradient
        for index in range(len(networks[0].layers) - 1):
            widths = [len(network.linear(index).bias) for network in networks]
            for flats, layers in ((self._hidden, values), (self._hidden_gradients, pulls)):
                flat, parts = _one_behind_another(inputs, widths)
                flats.append(flat)
                layers.append(parts)
        values, pulls = [*values, outputs], [*pulls, gradients]
        self._products: list[list[tuple[Tensor, Tensor, Tensor, Tensor]]] = []
        self._weight_gradients: list[list[tuple[Tensor, Tensor, Tensor, Any, Any]]] = []
        self._input_gradients: list[list[tuple[Tensor, Tensor, Tensor]]] = []
        for index, ((before, after), (below, above)) in enumerate(
            zip(pairwise(values), pairwise(pulls), strict=True)
        ):
            linear = [network.linear(index) for network in networks]
            weights = [each.weight.detach() for each in linear]
            biases = [each.bias.detach() for each in linear]
            own = [(each.weight.grad, each.bias.grad) for each in linear]
            places = range(len(networks))
            self._products.append([(biases[i], before[i], weights[i].mT, after[i]) for i in places])
            self._weight_gradients.append([(above[i], above[i].mT, before[i], *own[i]) for i in places])
            self._input_gradients.append([(above[i], weights[i], below[i]) for i in places])

    def forward(self) -> None:
        for products, hidden in zip(self._products, [*self._hidden, None], strict=True):
            for bias, value, matrix, result in products:
                torch.addmm(bias, value, matrix, out=result)
            if hidden is not None:
                self._activate_(hidden)

    def backward(self) -> None:
        for index in reversed(range(len(self._products))):
            for gradient, turned, value, weight, bias in self._weight_gradients[index]:
                torch.mm(turned, value, out=weight)
                torch.sum(gradient, 0, out=bias)
            if index:
                for gradient, matrix, result in self._input_gradients[index]:
                    torch.mm(gradient, matrix, out=result)
                self._backward_(self._hidden_gradients[index - 1], self._hidden[index - 1])


def _one_behind_another(like: Sequence[Tensor], widths: Sequence[int]) -> tuple[Tensor, list[Tensor]]:
    """Memory for a matrix of each width, with as many rows as each of ``like``: all of it, and its parts."""
    shapes = [(len(rows), width) for rows, width in zip(like, widths, strict=True)]
    flat = like[0].new_empty(sum(rows * width for rows, width in shapes))
    parts = flat.split([rows * width for rows, width in shapes])
    return flat, [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
