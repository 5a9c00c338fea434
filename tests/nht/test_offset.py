"""Affine maps, u = u0(c) + Q(c) a: laws, what training finds, and that all parts know of the offset."""

from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

import nht
from nht.demos import Demos
from nht.lipschitz import LipschitzProjection
from nht.maps import LinearActionMap

N, K, CONTEXT_DIM = 7, 2, 3
KINDS = ("none", "constant", "contextual")


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def make(kind: str, offset: Any) -> LinearActionMap:
    """A map with an offset that is far from zero."""
    map: LinearActionMap
    if kind == "svd":
        map = nht.SVD(N, K, CONTEXT_DIM, offset=offset)
    else:
        map = {"nht": nht.NHT, "scl": nht.SCL}[kind](CONTEXT_DIM, N, K, (8,), offset=offset)
    for name, value in map.double().state_dict().items():
        if "offset_model" in name and not name.endswith("context_std"):
            value.copy_(normal(*value.shape, seed=len(name)))
    return map


each_map = pytest.mark.parametrize(("kind", "offset"), list(product(("nht", "scl", "svd"), KINDS)))


@each_map
def test_no_action_gives_the_offset_and_the_rest_is_linear(kind: str, offset: str) -> None:
    map, context = make(kind, offset), normal(6, CONTEXT_DIM)
    action, rest = normal(6, K, seed=1), map.rest(context)
    assert rest.shape == (6, N)
    assert torch.equal(map(torch.zeros(6, K).double(), context), rest)
    assert torch.allclose(
        map(action, context), rest + (map.basis(context) @ action.unsqueeze(-1)).squeeze(-1)
    )
    assert rest.any() == (offset != "none")
    assert (rest == rest[0]).all() == (offset != "contextual")


@each_map
def test_projecting_is_least_squares_around_the_offset(kind: str, offset: str) -> None:
    map, context, actuation = make(kind, offset), normal(6, CONTEXT_DIM), normal(6, N, seed=1)
    nearest = torch.linalg.pinv(map.basis(context)) @ (actuation - map.rest(context)).unsqueeze(-1)
    assert torch.allclose(map.project(actuation, context), nearest.squeeze(-1))
    action = normal(6, K, seed=2)
    assert torch.allclose(map.project(map(action, context), context), action)
    missed = actuation - map(map.project(actuation, context), context)
    loss = map.loss(TensorDict({"actuation": actuation, "context": context}, batch_size=6))
    assert torch.allclose(loss, missed.square().sum(-1).mean())


@pytest.mark.parametrize("kind", ["nht", "scl"])
def test_a_contextual_offset_is_drawn_to_the_mean_and_the_basis_to_the_rest(kind: str) -> None:
    """The gradient of the loss, and to the offset that of a regression; within the span only the latter counts."""
    map, context, actuation = make(kind, "contextual"), normal(20, CONTEXT_DIM), normal(20, N, seed=1)
    batch = TensorDict({"actuation": actuation, "context": context}, batch_size=20)
    assert map.network is not None
    assert map.offset_model is not None
    basis = torch.autograd.grad(map.loss(batch), list(map.network.parameters()))
    missed = (actuation - map(map.project(actuation, context), context)).square().sum(-1).mean()
    expected = torch.autograd.grad(missed, list(map.network.parameters()), retain_graph=True)
    for found, other in zip(basis, expected, strict=True):
        assert torch.allclose(found, other, atol=1e-10)
    offset = torch.autograd.grad(map.loss(batch), list(map.offset_model.parameters()))
    both = missed + (actuation - map.rest(context)).square().sum(-1).mean()
    for found, other in zip(
        offset, torch.autograd.grad(both, list(map.offset_model.parameters())), strict=True
    ):
        assert torch.allclose(found, other, atol=1e-10)


def test_an_affine_svd_is_the_best_of_its_kind() -> None:
    """No gradient step on A, b and Q together finds a smaller error than the closed form."""
    context = normal(300, CONTEXT_DIM)
    actuation = normal(300, K, seed=1) @ normal(K, N, seed=2) + 0.5 * normal(300, N, seed=3)
    actuation = actuation + context @ normal(CONTEXT_DIM, N, seed=4) + normal(N, seed=5)
    map = nht.SVD(N, K, CONTEXT_DIM, offset="contextual").double()
    map.fit(TensorDict({"actuation": actuation, "context": context}, batch_size=300))
    best = (actuation - map(map.project(actuation, context), context)).square().sum(-1).mean()
    for seed in range(3):
        slope, value, columns = (
            (start + 0.1 * normal(*start.shape, seed=seed)).requires_grad_()
            for start in (map.offset_model.slope, map.offset_model.value, map.frame)
        )
        optimiser = torch.optim.LBFGS([slope, value, columns], max_iter=300, line_search_fn="strong_wolfe")

        def missed(slope: Tensor = slope, value: Tensor = value, columns: Tensor = columns) -> Tensor:
            way = actuation - context @ slope.mT - value
            frame = torch.linalg.qr(columns).Q
            return (way - way @ frame @ frame.mT).square().sum(-1).mean()

        def closure(optimiser: Any = optimiser, missed: Any = missed) -> Tensor:
            optimiser.zero_grad()
            missed().backward()
            return missed()

        optimiser.step(closure)
        assert float(missed()) == pytest.approx(float(best), rel=1e-4)
        assert float(missed()) >= float(best) * (1 - 1e-9)


def around(rest: Tensor) -> Demos:
    """Demonstrations u = rest + B a in R^7, of two dimensions."""
    context, action = normal(2_000, CONTEXT_DIM).float(), normal(2_000, K, seed=1).float()
    across = normal(N, K, seed=2)
    plane = torch.linalg.qr(
        across - across.mean(0)
    ).Q.float()  # across the direction in which all motors are alike
    return Demos.from_tensors(
        actuation=rest + action @ plane.mT, context=context, episode=torch.arange(2_000) // 50
    )


@pytest.fixture(scope="module")
def constant() -> Demos:
    return around(torch.tensor(0.5))


@pytest.mark.parametrize("kind", ["nht", "scl", "svd"])
def test_a_robot_that_rests_at_a_half_takes_two_dimensions(constant: Demos, kind: str) -> None:
    errors = {}
    for offset in ("none", "constant"):
        if kind == "svd":
            map: Any = nht.SVD(N, K, CONTEXT_DIM, offset=offset)
        else:
            map = {"nht": nht.NHT, "scl": nht.SCL}[kind](CONTEXT_DIM, N, K, (16,), offset=offset)
        metrics = nht.train_map(constant, map, max_steps=1_000, learning_rate=1e-2).metrics
        errors[offset] = metrics["validation_error"]
    assert errors["none"] > 0.2
    assert errors["constant"] < (1e-3 if kind == "scl" else 1e-5)
    assert metrics["action_scale"] < 5


def test_a_rest_that_moves_takes_a_contextual_offset() -> None:
    context = normal(2_000, CONTEXT_DIM).float()
    demos = around(torch.cat([context.sin(), context.cos(), context[:, :1]], dim=-1))
    errors = {
        offset: nht.train_map(
            demos, nht.NHT(CONTEXT_DIM, N, K, (32,), offset=offset), max_steps=1_500, learning_rate=1e-2
        ).metrics["validation_error"]
        for offset in ("constant", "contextual")
    }
    assert errors["contextual"] < 0.2 * errors["constant"]


def test_a_rank_is_that_around_the_offset(constant: Demos) -> None:
    narrow = Demos.from_tensors(
        actuation=0.5 + torch.linspace(-1, 1, 100)[:, None].expand(-1, N) * torch.arange(N),
        context=torch.randn(100, CONTEXT_DIM),
        episode=torch.arange(100) // 10,
    )
    nht.train_map(narrow, nht.SVD(N, 2, CONTEXT_DIM))
    with pytest.raises(
        ValueError, match="1 independent actuations, measured from their mean, too few for k = 2"
    ):
        nht.train_map(narrow, nht.SVD(N, 2, CONTEXT_DIM, offset="constant"))
    still = Demos.from_tensors(
        actuation=torch.full((100, N), 0.5),
        context=torch.randn(100, CONTEXT_DIM),
        episode=torch.arange(100) // 10,
    )
    with pytest.raises(ValueError, match="0 independent actuations, measured from their mean"):
        nht.train_map(still, nht.NHT(CONTEXT_DIM, N, 1, offset="constant"))


@each_map
@torch.no_grad()
def test_alignment_corrections_and_files_know_the_offset(kind: str, offset: str, tmp_path: Path) -> None:
    map, context, action = make(kind, offset), normal(6, CONTEXT_DIM), normal(6, K, seed=1)
    turned = nht.align(
        map, map.basis(context[0]) @ torch.tensor([[0.0, 1.0], [1.0, 0.0]]).double(), context[0]
    )
    assert torch.equal(turned.rest(context), map.rest(context))
    assert torch.allclose(turned(action, context), map(action.flip(-1), context))
    assert torch.allclose(turned.project(map(action, context), context), action.flip(-1))
    corrected = nht.Residual(map, 0.5)
    assert torch.equal(corrected.rest(context), map.rest(context))
    actuation = normal(6, N, seed=2)
    assert torch.allclose(corrected(corrected.project(actuation, context), context), actuation)
    for other in (map, turned, corrected):
        loaded = nht.load_map(nht.save_map(other, tmp_path / "map.safetensors"))
        given = normal(6, other.action_dim, seed=3)
        assert torch.equal(loaded(given, context), other(given, context))
        assert torch.equal(loaded.rest(context), other.rest(context))


@each_map
@torch.no_grad()
def test_the_offset_keeps_to_its_certificate(kind: str, offset: str) -> None:
    map = make(kind, offset)
    bound = nht.offset_certificate(map)
    assert bound == nht.offset_certificate(nht.Residual(map, 1.0)) == nht.offset_certificate(nht.Aligned(map))
    assert (bound > 0) == (offset == "contextual")
    context = normal(4_000, CONTEXT_DIM)
    for distance in (1e-4, 1.0):
        other = context + distance * normal(4_000, CONTEXT_DIM, seed=1)
        moved = (map.rest(context) - map.rest(other)).norm(dim=-1) / (context - other).norm(dim=-1)
        assert float(moved.max()) <= bound * (1 + 1e-9)
        if offset == "contextual":
            assert float(moved.max()) > 0.1 * bound


@pytest.mark.parametrize("norm", ["spectral", "frobenius"])
def test_a_limit_holds_for_basis_and_offset_each(norm: Any) -> None:
    map = nht.NHT(
        CONTEXT_DIM, N, K, (16, 16), lipschitz=0.5, lipschitz_norm=norm, offset="contextual", normalise=True
    )
    demos = around(3 * normal(2_000, CONTEXT_DIM).float() @ normal(CONTEXT_DIM, N, seed=4).float())
    nht.train_map(demos, map, max_steps=300, learning_rate=1e-2)
    assert 0.05 < nht.offset_certificate(map) <= 0.5
    assert nht.certificate(map) <= 0.5
    with torch.no_grad():
        for weight in map.parameters():
            weight.mul_(10)
    LipschitzProjection(map)
    assert max(nht.certificate(map), nht.offset_certificate(map)) <= 0.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: nht.NHT(3, 7, 2, offset="linear"),
            "offset must be one of none, constant, contextual, got 'linear'",
        ),
        (
            lambda: nht.SVD(7, 2, offset="contextual"),
            "offset='contextual' needs a context, got context_dim=0",
        ),
        (lambda: nht.NHT(3, 7, 2, start="pca"), "start must be one of svd, random, got 'pca'"),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
