"""NHT starts at SVD's plane: the reflectors that span it, and that training never ends below it."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

import nht
from nht.demos import Demos
from nht.geometry import householder_frame, principal_directions, spanning_reflectors, sphere_exp, sphere_log
from nht.training_data import split_episodes

N, K, CONTEXT_DIM = 6, 2, 3


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frames(n: int, k: int, seed: int) -> list[Tensor]:
    """A random one, and those whose columns are axes, forward, backward and exchanged."""
    axes = torch.eye(n, dtype=torch.float64)
    return [
        torch.linalg.qr(normal(n, k, seed=seed)).Q,
        axes[:, :k],
        -axes[:, :k],
        axes[:, n - k :],
        axes.flip(-1)[:, :k],
    ]


@settings(deadline=None, max_examples=40)
@given(
    st.integers(2, 8).flatmap(lambda n: st.tuples(st.just(n), st.integers(1, n))),
    st.integers(0, 1_000),
)
def test_reflectors_span_any_frame(sizes: tuple[int, int], seed: int) -> None:
    n, k = sizes
    for frame in frames(n, k, seed):
        reflectors = spanning_reflectors(frame)
        assert torch.allclose(reflectors.norm(dim=-1), torch.ones(k, dtype=torch.float64))
        assert (reflectors[:, 0] >= -1e-12).all()
        found = householder_frame(reflectors)
        assert torch.allclose(
            (found * frame).sum(0).abs(), torch.ones(k, dtype=torch.float64)
        )  # but for signs
        again = sphere_exp(sphere_log(reflectors))
        assert torch.allclose(again, reflectors, atol=1e-12)


def test_the_logarithm_inverts_the_exponential() -> None:
    tangent = normal(100, 4)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True) * torch.linspace(0, 3.1, 100)[:, None]
    assert torch.allclose(sphere_log(sphere_exp(tangent)), tangent, atol=1e-7)
    assert sphere_log(torch.tensor([1.0, 0.0, 0.0])).tolist() == [0, 0]
    assert sphere_log(torch.tensor([-1.0, 0.0, 0.0])).isfinite().all()


@pytest.mark.parametrize(
    "options",
    [{}, {"multi_head": True}, {"offset": "constant"}, {"offset": "contextual"}, {"normalise": True}],
)
@pytest.mark.parametrize("k", [1, 2, 5, 6])
@torch.no_grad()
def test_the_start_is_the_plane_of_svd(options: dict[str, Any], k: int) -> None:
    context, actuation = normal(80, CONTEXT_DIM), normal(80, N, seed=1) @ normal(N, N, seed=2) + 1
    batch = TensorDict({"context": context, "actuation": actuation}, batch_size=80)
    map = nht.NHT(CONTEXT_DIM, N, k, (8,), **options).double()
    assert not map.fit(batch)
    flat = nht.SVD(N, k, CONTEXT_DIM, offset="constant" if "offset" in options else "none").double()
    flat.fit(batch)
    ours, theirs = map.basis(normal(5, CONTEXT_DIM, seed=3)), flat.basis(normal(5, CONTEXT_DIM))
    assert torch.allclose(ours @ ours.mT, theirs @ theirs.mT, atol=1e-10)
    assert torch.allclose(map.rest(context), flat.rest(context))


def test_a_random_start_is_what_it_was() -> None:
    batch = TensorDict(
        {"context": normal(80, CONTEXT_DIM), "actuation": normal(80, N, seed=1)}, batch_size=80
    )
    map = nht.NHT(CONTEXT_DIM, N, K, (8,), start="random").double()
    before = {name: value.clone() for name, value in map.state_dict().items()}
    map.fit(batch)
    assert all(torch.equal(value, before[name]) for name, value in map.state_dict().items())


def test_a_trained_map_goes_on_from_where_it_is(demos: Demos) -> None:
    map = nht.NHT(CONTEXT_DIM, N, K, (16,), offset="contextual")
    first = nht.train_map(demos, map, max_steps=250).metrics["validation_error"]
    before = map.network.linear(-1).bias.clone()
    again = nht.train_map(demos, map, max_steps=1, learning_rate=1e-6).metrics["validation_error"]
    assert again == pytest.approx(first, rel=1e-3)
    torch.testing.assert_close(map.network.linear(-1).bias, before, rtol=0, atol=1e-5)


def test_fewer_actuations_than_directions_are_enough_to_start() -> None:
    directions = principal_directions(normal(2, N), 4)
    assert torch.allclose(directions.mT @ directions, torch.eye(4, dtype=torch.float64))


@pytest.fixture(scope="module")
def demos() -> Demos:
    """A plane that turns with the context, in noise."""
    context = normal(1_500, CONTEXT_DIM).float()
    plane = nht.NHT(CONTEXT_DIM, N, K, (8,), seed=11)
    with torch.no_grad():
        plane.network.linear(-1).weight.mul_(3)
        actuation = plane(normal(1_500, K, seed=1).float(), context) + 0.2 * normal(1_500, N, seed=2).float()
    return Demos.from_tensors(actuation=actuation, context=context, episode=torch.arange(1_500) // 50)


def svd_error(demos: Demos, seed: int) -> float:
    return nht.train_map(demos, nht.SVD(N, K, CONTEXT_DIM), seed=seed).metrics["validation_error"]


@pytest.mark.parametrize("limit", [1e-6, 1e-3, 1e-2])
@pytest.mark.parametrize(
    "options", [{}, {"multi_head": True, "lipschitz_norm": "frobenius"}, {"normalise": True}]
)
def test_a_strict_limit_leaves_the_plane_of_svd(demos: Demos, limit: float, options: dict[str, Any]) -> None:
    map = nht.NHT(CONTEXT_DIM, N, K, (16,), lipschitz=limit, **options)
    metrics = nht.train_map(demos, map, max_steps=250).metrics
    best = svd_error(demos, seed=0)
    assert metrics["certificate"] <= limit
    assert (0.98 - 5 * limit) * best <= metrics["validation_error"] <= best * (1 + 1e-5)


@pytest.mark.parametrize("rate", [1e-4, 1e-2, 0.5])
@pytest.mark.parametrize("seed", [0, 1])
def test_training_never_ends_below_svd(demos: Demos, rate: float, seed: int) -> None:
    map = nht.NHT(CONTEXT_DIM, N, K, (16,), lipschitz=0.3, seed=seed)
    metrics = nht.train_map(demos, map, max_steps=250, learning_rate=rate, seed=seed).metrics
    assert metrics["validation_error"] <= svd_error(demos, seed) * (1 + 1e-6)
    held_out = split_episodes(demos.episode, 0.1, seed)
    found = nht.projection_error(map, demos.context(["context"])[held_out], demos.actuation[held_out])
    assert found == metrics["validation_error"]


def test_a_limit_is_kept_from_the_start_on(demos: Demos) -> None:
    """The last layer starts at zero, from which the power iteration has to find its way."""
    map = nht.NHT(CONTEXT_DIM, N, K, (16, 16), lipschitz=0.2)
    nht.train_map(demos, map, max_steps=500, learning_rate=3e-2)
    assert 0.1 < nht.certificate(map) <= 0.2
