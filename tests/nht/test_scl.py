"""The map without structure: its projection is safe where its basis is not."""

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

import nht
from nht.envs import make_env
from nht.geometry import least_squares
from nht.lipschitz import LipschitzProjection
from nht.transforms import ActionMapTransform

CONTEXT_DIM, N, K = 4, 7, 3


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def batch(count: int = 32, dtype: torch.dtype = torch.float64) -> TensorDict:
    entries = {"context": normal(count, CONTEXT_DIM, dtype=dtype), "actuation": normal(count, N, dtype=dtype)}
    return TensorDict(entries, batch_size=count)


@pytest.mark.parametrize(("n", "k"), [(1, 1), (3, 3), (7, 2), (12, 6)])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_least_squares_agrees_with_the_pseudo_inverse(
    n: int, k: int, size: float, dtype: torch.dtype
) -> None:
    orthonormal = torch.linalg.qr(normal(20, n, k)).Q
    basis = size * orthonormal * torch.linspace(0.3, 1, k, dtype=torch.float64)
    actuation = normal(20, n, seed=1)
    expected = (torch.linalg.pinv(basis) @ actuation.unsqueeze(-1)).squeeze(-1)
    found = least_squares(basis.to(dtype), actuation.to(dtype)).double()
    assert (found - expected).norm() / expected.norm() < (1e-4 if dtype == torch.float32 else 1e-12)


def deficient(kind: str, dtype: torch.dtype) -> Tensor:
    basis = normal(16, N, K, dtype=dtype)
    if kind == "zero":
        return torch.zeros_like(basis)
    if kind == "zero column":
        return basis * torch.tensor([1.0, 0.0, 1.0], dtype=dtype)
    if kind == "equal columns":
        return basis[..., :1].expand(-1, -1, K).clone()
    if kind == "equal entries":
        return torch.ones_like(basis)
    return basis * 1e30 if kind == "huge" else basis * 1e-30


@pytest.mark.parametrize("kind", ["zero", "zero column", "equal columns", "equal entries", "huge", "tiny"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_bad_basis_gives_finite_actions_and_gradients(kind: str, dtype: torch.dtype) -> None:
    basis = deficient(kind, dtype).requires_grad_()
    actuation = normal(16, N, seed=1, dtype=dtype)
    action = least_squares(basis, actuation)
    reached = (basis @ action.unsqueeze(-1)).squeeze(-1)
    assert action.isfinite().all()
    if kind != "tiny":
        nearest = (basis @ (torch.linalg.pinv(basis) @ actuation.unsqueeze(-1))).squeeze(-1)
        assert torch.allclose(reached, nearest, atol=1e-4)
    (gradient,) = torch.autograd.grad((actuation - reached).square().sum(), basis)
    assert gradient.isfinite().all()


def test_what_a_deficient_basis_leaves_open_gets_about_the_smallest_action() -> None:
    basis = deficient("equal columns", torch.float64)
    actuation = normal(16, N, seed=1)
    smallest = (torch.linalg.pinv(basis) @ actuation.unsqueeze(-1)).squeeze(-1)
    assert (least_squares(basis, actuation).norm(dim=-1) < 1.1 * smallest.norm(dim=-1)).all()


def test_the_gradient_of_the_loss_is_that_of_eq_6() -> None:
    map, data = nht.SCL(CONTEXT_DIM, N, K, hidden=(8,)).double(), batch()
    ours = torch.autograd.grad(map.loss(data), list(map.parameters()))
    basis = map.basis(data["context"])
    missed = data["actuation"].unsqueeze(-1) - basis @ (
        torch.linalg.pinv(basis) @ data["actuation"].unsqueeze(-1)
    )
    loss = missed.square().sum((-2, -1)).mean()
    assert torch.allclose(map.loss(data), loss)
    for found, expected in zip(ours, torch.autograd.grad(loss, list(map.parameters())), strict=True):
        assert torch.allclose(found, expected, atol=1e-12)


def test_the_loss_ignores_the_norm_of_the_basis() -> None:
    map, data = nht.SCL(CONTEXT_DIM, N, K).double(), batch()
    before = map.loss(data)
    with torch.no_grad():
        for parameter in map.network.linear(-1).parameters():
            parameter.mul_(1000)
    assert torch.allclose(map.loss(data), before)


@torch.no_grad()
def test_a_rank_deficient_start_does_not_poison_the_training() -> None:
    map, data = nht.SCL(CONTEXT_DIM, N, K, hidden=(16,)), batch(dtype=torch.float32)
    for parameter in map.network.linear(-1).parameters():
        parameter.unflatten(0, (N, K))[:, 1:] = parameter.unflatten(0, (N, K))[:, :1]
    optimiser = torch.optim.Adam(map.parameters(), lr=1e-2)
    first = map.loss(data)
    with torch.enable_grad():
        for _ in range(200):
            optimiser.zero_grad()
            map.loss(data).backward()
            optimiser.step()
    assert all(parameter.isfinite().all() for parameter in map.parameters())
    assert map.loss(data) < 0.5 * first


@torch.no_grad()
@pytest.mark.parametrize("size", [1e3, 1e20, 1e38])
def test_the_environment_survives_a_basis_of_any_norm(size: float) -> None:
    map = nht.SCL(10, 7, 2, hidden=(16,))
    for parameter in map.network.linear(-1).parameters():
        parameter.mul_(size)
    transform = ActionMapTransform(map, ["tool_position", "joint_angle"], action_scale=1.0)
    steps = TransformedEnv(make_env("wam_wipe", num_envs=2, seed=0), transform).rollout(
        20, break_when_any_done=False
    )
    assert steps["next", "observation"].isfinite().all()
    assert steps["next", "actuation"].abs().max() == 2  # the joints' largest speed


@torch.no_grad()
@pytest.mark.parametrize("limit", [None, 0.5])
@pytest.mark.parametrize("activation", ["relu", "sigmoid", "tanh"])
def test_no_pair_of_contexts_exceeds_the_certificate(limit: float | None, activation: Any) -> None:
    map = nht.SCL(CONTEXT_DIM, N, K, (24, 24), activation, lipschitz=limit).double()
    map.network.context_std.fill_(0.3)
    if limit is not None:
        for layer in (0, 1, 2):
            map.network.linear(layer).weight.mul_(20)
        LipschitzProjection(map)
        assert nht.certificate(map) == pytest.approx(limit, rel=1e-5)
    context = normal(4000, CONTEXT_DIM)
    for distance in (1e-5, 1e-2, 1.0):
        other = context + distance * normal(4000, CONTEXT_DIM, seed=1)
        change = torch.linalg.matrix_norm(map.basis(context) - map.basis(other), ord=2)
        assert 0 < float((change / (context - other).norm(dim=-1)).max()) <= nht.certificate(map)


@torch.no_grad()
def test_the_certificate_is_attained_by_a_single_column() -> None:
    map = nht.SCL(1, N, 1, hidden=()).double()
    one, zero = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    change = torch.linalg.matrix_norm(map.basis(one) - map.basis(zero), ord=2)
    assert math.isclose(float(change), nht.certificate(map), rel_tol=1e-9)


def test_the_columns_start_at_about_unit_length_and_full_rank() -> None:
    lengths = torch.linalg.svdvals(nht.SCL(CONTEXT_DIM, 30, 4, seed=2).basis(torch.zeros(CONTEXT_DIM)))
    assert 0.3 < float(lengths.min().detach()) < float(lengths.max().detach()) < 2


def test_the_seed_decides_the_start() -> None:
    bases = [nht.SCL(CONTEXT_DIM, N, K, seed=seed).basis(torch.zeros(CONTEXT_DIM)) for seed in (3, 3, 4)]
    assert torch.equal(bases[0], bases[1])
    assert not torch.equal(bases[0], bases[2])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nht.SCL(4, 7, 8), "action_dim must be in 1 ... actuation_dim=7, got 8"),
        (lambda: nht.SCL(0, 7, 2), "widths must be at least 1, got context_dim=0"),
        (
            lambda: nht.SCL(4, 7, 2, activation="gelu"),
            "activation must be one of relu, sigmoid, tanh, got 'gelu'",
        ),
        (lambda: nht.SCL(4, 7, 2, lipschitz=-1.0), "lipschitz must be a positive number or None, got -1.0"),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
