"""The certificate is a bound, and training's projection keeps maps within their limit."""

import math

import pytest
import torch
from torch import Tensor, nn

import nht
from nht.lipschitz import LipschitzProjection, certificate
from nht.maps import ActionMap, NormKind
from nht.networks import Activation

ACTIVATIONS: list[Activation] = ["relu", "sigmoid", "tanh"]
CONTEXT_DIM = 5


def wild(activation: Activation = "tanh", **options: object) -> nht.NHT:
    """A map with large random weights and a normaliser, far over any limit."""
    map = nht.NHT(CONTEXT_DIM, 7, 3, hidden=(24, 24), activation=activation, **options).double()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for layer in map.network.layers:
            layer.weight.mul_(20)
        if map.multi_head:
            map.network.layers[-1].weight[0].mul_(3)
        map.network.context_mean.uniform_(-1, 1, generator=generator)
        map.network.context_std.uniform_(0.1, 2, generator=generator)
    return map


@torch.no_grad()
def largest_ratio(map: nht.NHT, distance: float) -> float:
    """The largest |Q(c) - Q(c')| / |c - c'| over random pairs about `distance` apart."""
    generator = torch.Generator().manual_seed(0)
    context = 2 * torch.randn(4000, CONTEXT_DIM, generator=generator, dtype=torch.float64)
    other = context + distance * torch.randn(4000, CONTEXT_DIM, generator=generator, dtype=torch.float64)
    change = torch.linalg.matrix_norm(map.basis(context) - map.basis(other), ord=2)
    return float((change / (context - other).norm(dim=-1)).max())


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("limit", [None, 0.5, 3.0])
@pytest.mark.parametrize("multi_head", [False, True])
def test_no_pair_of_contexts_exceeds_the_certificate(
    activation: Activation, limit: float | None, multi_head: bool
) -> None:
    map = wild(activation, lipschitz=limit, multi_head=multi_head)
    if limit is not None:
        LipschitzProjection(map)
        assert certificate(map) <= limit
    for distance in (1e-5, 1e-2, 1.0):
        assert 0 < largest_ratio(map, distance) <= certificate(map)


@pytest.fixture(scope="module")
def demos() -> nht.Demos:
    """Actuations on a plane that turns fast with the context: fits run into a limit of 2."""
    generator = torch.Generator().manual_seed(0)
    context = torch.randn(2000, CONTEXT_DIM, generator=generator)
    action = torch.randn(2000, 3, generator=generator)
    with torch.no_grad():
        actuation = wild().float()(action, context)
    return nht.Demos.from_tensors(actuation=actuation, context=context, episode=torch.arange(2000) // 50)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("multi_head", [False, True])
def test_trained_maps_keep_the_bound_of_eq_22(
    demos: nht.Demos, activation: Activation, multi_head: bool
) -> None:
    map = nht.NHT(CONTEXT_DIM, 7, 3, (24, 24), activation, lipschitz=2.0, multi_head=multi_head)
    metrics = nht.train_map(demos, map, max_steps=300, learning_rate=1e-2).metrics
    assert 1.5 < metrics["certificate"] == certificate(map) <= 2.0
    for distance in (1e-4, 1e-2, 1.0):
        assert 0 < largest_ratio(map.double(), distance) <= certificate(map)


@torch.no_grad()
def test_the_certificate_is_not_idle() -> None:
    """A linear network with one reflection attains 2 |W| / std, its certificate, where it is at zero."""
    map = nht.NHT(1, 2, 1, hidden=()).double()
    with torch.no_grad():
        map.network.layers[0].weight.fill_(0.7)
        map.network.layers[0].bias.zero_()
        map.network.context_std.fill_(0.5)
    near, zero = torch.full((1,), 1e-6, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    ratio = torch.linalg.matrix_norm(map.basis(near) - map.basis(zero), ord=2) / 1e-6
    assert float(ratio) == pytest.approx(certificate(map)) == pytest.approx(2 * 0.7 / 0.5)


@torch.no_grad()
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_each_layer_gets_its_share_of_the_limit(activation: Activation) -> None:
    """(L / (2 sqrt k))^(1 / layers), times what the activation's slope leaves over."""
    map = wild(activation, lipschitz=2.0)
    LipschitzProjection(map)
    slope = 0.25 if activation == "sigmoid" else 1.0
    share = (2.0 / (2 * math.sqrt(3))) ** (1 / 3)
    first, second, last = (spectral(layer) for layer in map.network.layers)
    effective = float(torch.linalg.matrix_norm(map.network.layers[0].weight / map.network.context_std, ord=2))
    assert effective == pytest.approx(share / slope, rel=1e-5) != pytest.approx(first)
    assert (second, last) == pytest.approx((share / slope, share), rel=1e-5)
    assert certificate(map) == pytest.approx(2.0, rel=1e-5)


@torch.no_grad()
def spectral(layer: nn.Module) -> float:
    assert isinstance(layer, nn.Linear)
    return float(torch.linalg.matrix_norm(layer.weight, ord=2))


@torch.no_grad()
def test_frobenius_limits_are_stricter() -> None:
    map = wild(lipschitz=2.0, lipschitz_norm="frobenius")
    LipschitzProjection(map)
    share = (2.0 / (2 * math.sqrt(3))) ** (1 / 3)
    assert float(torch.linalg.matrix_norm(map.network.layers[1].weight)) == pytest.approx(share, rel=1e-5)
    assert certificate(map) < 0.5


def test_maps_within_their_limit_are_left_alone() -> None:
    map = nht.NHT(CONTEXT_DIM, 7, 3, lipschitz=1e6)
    before = [weight.clone() for weight in map.parameters()]
    projection = LipschitzProjection(map)
    projection.step()
    assert all(torch.equal(a, b) for a, b in zip(before, map.parameters(), strict=True))


@pytest.mark.parametrize("kind", ["spectral", "frobenius"])
def test_steps_follow_moving_weights_and_exact_is_exact_in_single_precision(kind: NormKind) -> None:
    map = nht.NHT(CONTEXT_DIM, 7, 3, hidden=(64, 64), lipschitz=2.0, lipschitz_norm=kind)
    projection = LipschitzProjection(map)
    generator = torch.Generator().manual_seed(0)
    for _ in range(100):
        with torch.no_grad():
            for weight in map.parameters():
                weight.add_(0.01 * torch.randn(weight.shape, generator=generator))
        projection.step()
        assert certificate(map) < 2.0 * 1.2
    projection.exact()
    assert certificate(map) <= 2.0


def test_constants_of_maps_without_a_network() -> None:
    class Opaque(ActionMap):
        def forward(self, action: Tensor, context: Tensor) -> Tensor:
            return action

        def project(self, actuation: Tensor, context: Tensor) -> Tensor:
            return actuation

    assert certificate(nht.SVD(7, 2)) == certificate(nht.Identity(7)) == 0
    assert certificate(Opaque(1, 2, 2)) == math.inf


def test_a_projection_needs_a_network_and_a_limit() -> None:
    with pytest.raises(ValueError, match="NHT has no network to limit, or no limit: lipschitz=None"):
        LipschitzProjection(nht.NHT(CONTEXT_DIM, 7, 3))
    with pytest.raises(ValueError, match="SVD has no network"):
        LipschitzProjection(nht.SVD(7, 2))
