"""Eq. 22 for what reaches the motors: no pair of contexts moves one action's actuation faster than is certified."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import nht
from nht.maps import ActionMap

N, K, CONTEXT_DIM = 5, 2, 3
LIMITS: dict[str, tuple[Any, Any]] = {
    "none": (None, None),
    "cube": (torch.full((N,), -1.0), torch.full((N,), 1.0)),
    "box": (torch.tensor([-0.7, -2.0, -1.0, -0.8, -5.0]), torch.tensor([1.5, 0.6, 1.0, 3.0, 0.9])),
    "one side": (None, torch.full((N,), 0.8)),
    "some": (torch.full((N,), -0.9), torch.tensor([math.inf, 0.7, math.inf, 1.0, math.inf])),
}


def wild(kind: str, offset: Any) -> ActionMap:
    """A map that turns fast; its offset stays within the limits."""
    if kind == "scl":
        map: Any = nht.SCL(CONTEXT_DIM, N, K, (16,), offset=offset).double()
    else:
        map = nht.NHT(CONTEXT_DIM, N, K, (16,), offset=offset).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for layer in map.network.layers:
            layer.weight.mul_(6)
        if offset == "constant":
            map.offset_model.value.uniform_(-0.3, 0.3, generator=generator)
        if offset == "contextual":
            map.offset_model.network.layers[0].weight.mul_(5)
            map.offset_model.network.layers[1].weight.uniform_(-0.03, 0.03, generator=generator)
    map.set_action_scale(4.0)
    if kind == "residual":
        return nht.Residual(map, 0.5)
    return nht.Aligned(map) if kind == "aligned" else map


@pytest.mark.parametrize("kind", ["nht", "scl", "residual", "aligned"])
@pytest.mark.parametrize("offset", ["none", "constant", "contextual"])
@pytest.mark.parametrize("saturation", ["scale", "clip"])
@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
@torch.no_grad()
def test_no_pair_of_contexts_exceeds_it(
    kind: str, offset: str, saturation: Any, limits: tuple[Any, Any]
) -> None:
    map = wild(kind, offset)
    map.saturation = saturation
    low, high = (None if limit is None else limit.double() for limit in limits)
    bound = nht.actuation_certificate(map, None, low, high)
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    context, corners = normal(3_000, CONTEXT_DIM), normal(3_000, map.action_dim).sign()
    for action in (corners, 0.2 * normal(3_000, map.action_dim).clamp(-1, 1)):
        for distance in (1e-5, 1e-2, 1.0):
            other = context + distance * normal(3_000, CONTEXT_DIM)
            moved = map.decode(action, context, low, high) - map.decode(action, other, low, high)
            ratio = float((moved.norm(dim=-1) / (context - other).norm(dim=-1)).max())
            assert 0 < ratio <= bound
    if kind != "scl":
        assert (
            bound < math.inf
            or (low is None and high is not None)
            or bool(high is not None and high.isinf().any())
        )


@torch.no_grad()
def test_without_limits_and_with_clip_it_is_that_of_eq_22() -> None:
    map = wild("nht", "contextual")
    expected = 3.0 * nht.certificate(map) + nht.offset_certificate(map)
    low, high = LIMITS["cube"]
    map.saturation = "clip"
    assert nht.actuation_certificate(map, 3.0) == nht.actuation_certificate(map, 3.0, low, high) == expected
    map.saturation = "scale"
    assert nht.actuation_certificate(map, 3.0) == expected < nht.actuation_certificate(map, 3.0, low, high)
    assert nht.actuation_certificate(map) == pytest.approx(
        4.0 * math.sqrt(2) * nht.certificate(map) + nht.offset_certificate(map)
    )


def test_scaling_into_a_cube_costs_the_root_of_n() -> None:
    map = wild("nht", "none")
    map.saturation = "scale"
    ones = torch.ones(N)
    free = nht.actuation_certificate(map, 1e3)
    assert nht.actuation_certificate(map, 1e3, -ones, ones) == pytest.approx(math.sqrt(N) * free)
    assert nht.actuation_certificate(map, 1.5, -ones, ones) == pytest.approx(
        1.5 * 1.5 * free / 1e3
    )  # |d| / room
    assert nht.actuation_certificate(map, 0.9, -ones, ones) == pytest.approx(
        0.9 * free / 1e3
    )  # never at a limit


@torch.no_grad()
def test_the_factor_is_attained() -> None:
    """A basis that turns while the actuation points into a corner of a square: sqrt(2) is what it costs."""
    map = nht.NHT(1, 2, 1, hidden=()).double()
    map.network.layers[0].weight.fill_(0.5)
    map.network.layers[0].bias.fill_(
        math.pi / 8 + 1e-4
    )  # reflector at pi / 8: Q at 3 pi / 4, but for the sign
    map.saturation = "scale"
    ones = torch.ones(2).double()
    long = 1.4142
    near = torch.tensor([[1e-6], [0.0]]).double()
    turned = map.decode(torch.full((2, 1), long).double(), near, -ones, ones)
    ratio = float((turned[0] - turned[1]).norm() / 1e-6)
    assert ratio == pytest.approx(nht.actuation_certificate(map, long, -ones, ones), rel=1e-2)


def test_where_nothing_is_known_it_is_infinite() -> None:
    ones = torch.ones(N)
    map = wild("nht", "none")
    map.saturation = "scale"
    assert nht.actuation_certificate(map, 3.0, 0 * ones, ones) == math.inf  # the rest is at a limit
    linear = nht.SVD(N, K, CONTEXT_DIM, offset="contextual")
    linear.saturation = "scale"
    linear.offset_model.slope.fill_(1.0)  # type: ignore[union-attr]
    assert nht.actuation_certificate(linear, 3.0, -ones, ones) == math.inf  # somewhere it rests beyond them
    assert nht.actuation_certificate(linear, 3.0) == nht.offset_certificate(linear) < math.inf
    assert nht.actuation_certificate(nht.LASER(CONTEXT_DIM, N, K)) == math.inf
    with pytest.raises(ValueError, match="largest_action must be a number of 0 or more, got nan"):
        nht.actuation_certificate(map, math.nan)
