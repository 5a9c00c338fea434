"""What every action map keeps, and what the linear ones do."""

import copy
import pickle
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

import nht
from nht.geometry import householder_frame
from nht.maps import ActionMap, LinearActionMap
from nht.networks import ContextNetwork

CONTEXT_DIM = 4


class FreeBasis(LinearActionMap):
    """A basis without structure, straight from a network: what the defaults of `LinearActionMap` must cope with."""

    def __init__(
        self, actuation_dim: int, action_dim: int, context_dim: int, lipschitz: float | None = None
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim, lipschitz)
        self.network = ContextNetwork(context_dim, actuation_dim * action_dim, (8,), "tanh", seed=0)
        self.network_gain = 1.0

    def basis(self, context: Tensor) -> Tensor:
        assert self.network is not None
        return self.network(context).unflatten(-1, (self.actuation_dim, self.action_dim))


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def every_map() -> list[ActionMap]:
    trained_svd = nht.SVD(7, 2, CONTEXT_DIM)
    trained_svd.fit(
        TensorDict({"actuation": normal(50, 7), "context": normal(50, CONTEXT_DIM)}, batch_size=50)
    )
    maps = [
        nht.NHT(CONTEXT_DIM, 7, 2, hidden=(16,)),
        nht.NHT(CONTEXT_DIM, 7, 3, hidden=(), activation="relu"),
        nht.NHT(CONTEXT_DIM, 3, 3, hidden=(8, 8, 8), activation="sigmoid", normalise=True),
        nht.NHT(CONTEXT_DIM, 6, 4, hidden=(16, 8), multi_head=True),
        trained_svd,
        nht.Identity(7, CONTEXT_DIM),
        nht.SCL(CONTEXT_DIM, 7, 3, hidden=(16,), normalise=True),
        FreeBasis(7, 2, CONTEXT_DIM),
    ]
    return [map.double() for map in maps]


each_map = pytest.mark.parametrize(
    "map", every_map(), ids=lambda map: f"{type(map).__name__}-{map.action_dim}"
)


@each_map
def test_projecting_an_actuation_of_the_map_gives_its_action(map: ActionMap) -> None:
    action, context = normal(3, 5, map.action_dim), normal(3, 5, CONTEXT_DIM, seed=1)
    actuation = map(action, context)
    assert actuation.shape == (3, 5, map.actuation_dim)
    assert torch.allclose(map.project(actuation, context), action, atol=1e-10)


@each_map
def test_forward_project_and_loss_follow_from_the_basis(map: LinearActionMap) -> None:
    action, actuation = normal(6, map.action_dim), normal(6, map.actuation_dim, seed=1)
    context = normal(6, CONTEXT_DIM, seed=2)
    basis = map.basis(context)
    assert basis.shape == (6, map.actuation_dim, map.action_dim)
    assert torch.allclose(map(action, context), (basis @ action.unsqueeze(-1)).squeeze(-1))
    nearest = (torch.linalg.pinv(basis) @ actuation.unsqueeze(-1)).squeeze(-1)
    assert torch.allclose(map.project(actuation, context), nearest)
    loss = map.loss(TensorDict({"actuation": actuation, "context": context}, batch_size=6))
    missed = actuation - (basis @ nearest.unsqueeze(-1)).squeeze(-1)
    assert torch.allclose(loss, missed.square().sum(-1).mean())


@each_map
def test_a_single_transition_needs_no_batch_dimension(map: ActionMap) -> None:
    action, context = normal(map.action_dim), normal(CONTEXT_DIM, seed=1)
    batched = map(action.unsqueeze(0), context.unsqueeze(0)).squeeze(0)
    assert torch.allclose(map(action, context), batched)


@each_map
def test_maps_copy_pickle_and_rebuild_from_their_arguments(map: ActionMap) -> None:
    action, context = normal(6, map.action_dim), normal(6, CONTEXT_DIM, seed=1)
    twin = type(map)(**map.init_args()).double()
    twin.load_state_dict(map.state_dict())
    for other in (copy.deepcopy(map), pickle.loads(pickle.dumps(map)), twin):
        assert torch.equal(other(action, context), map(action, context))


def test_maps_without_context_take_an_empty_one() -> None:
    for map in (nht.SVD(7, 2), nht.Identity(7)):
        assert map(torch.ones(5, map.action_dim), torch.ones(5, 0)).shape == (5, 7)
        assert map.basis(torch.ones(5, 0)).shape == (5, 7, map.action_dim)


@settings(deadline=None, max_examples=30)
@given(
    st.integers(2, 8).flatmap(lambda n: st.tuples(st.just(n), st.integers(1, n))),
    st.sampled_from(["relu", "sigmoid", "tanh"]),
    st.integers(0, 1000),
)
def test_nht_bases_are_orthonormal(sizes: tuple[int, int], activation: Any, seed: int) -> None:
    n, k = sizes
    map = nht.NHT(CONTEXT_DIM, n, k, hidden=(16, 16), activation=activation, seed=seed).double()
    context = 10 * normal(20, CONTEXT_DIM)
    basis = map.basis(context)
    assert torch.allclose(basis.mT @ basis, torch.eye(k, dtype=torch.float64).expand(20, k, k), atol=1e-13)
    assert torch.equal(basis, householder_frame(map.reflectors(context)))


def test_nht_gradients_agree_with_finite_differences() -> None:
    map = nht.NHT(CONTEXT_DIM, 5, 2, hidden=(6,)).double()
    with torch.no_grad():
        map.network.layers[-1].weight.zero_()
        map.network.layers[-1].bias.zero_()  # every tangent vector is 0
    parameters = dict(map.named_parameters())
    action, context = normal(3, 2), normal(3, CONTEXT_DIM, seed=1)

    def actuation(*values: Tensor) -> Tensor:
        return torch.func.functional_call(map, dict(zip(parameters, values, strict=True)), (action, context))

    assert torch.autograd.gradcheck(actuation, tuple(parameters.values()))
    assert map(action, context).sum().backward() is None
    assert all(layer.grad is not None and layer.grad.isfinite().all() for layer in map.parameters())
    assert parameters["network.layers.1.weight"].grad.abs().max() > 0


def test_the_seed_alone_decides_the_initial_weights() -> None:
    before = torch.random.get_rng_state()
    first = nht.NHT(CONTEXT_DIM, 7, 2, seed=3).state_dict()
    torch.rand(3)
    again = nht.NHT(CONTEXT_DIM, 7, 2, seed=3).state_dict()
    other = nht.NHT(CONTEXT_DIM, 7, 2, seed=4).state_dict()
    torch.random.set_rng_state(before)
    nht.NHT(CONTEXT_DIM, 7, 2, seed=5)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["network.layers.0.weight"], other["network.layers.0.weight"])


def test_heads_are_one_layer_with_a_block_diagonal_matrix() -> None:
    map = nht.NHT(CONTEXT_DIM, 6, 3, hidden=(16, 8), multi_head=True).double()
    heads = map.network.linear(-1)
    assert map.network.linear(-2).weight.shape == (3 * 8, 16)
    hidden = normal(5, 3 * 8)
    dense = hidden @ torch.block_diag(*heads.weight).mT + heads.bias.flatten()
    torch.testing.assert_close(heads(hidden), dense)


def test_each_head_moves_its_own_reflector_alone() -> None:
    map = nht.NHT(CONTEXT_DIM, 6, 3, hidden=(16, 8), multi_head=True).double()
    before = map.reflectors(normal(5, CONTEXT_DIM))
    with torch.no_grad():
        map.network.linear(-2).weight[8:16].add_(1)  # the last hidden layer of the second head
    after = map.reflectors(normal(5, CONTEXT_DIM))
    assert [bool((before[:, i] != after[:, i]).any()) for i in range(3)] == [False, True, False]


def test_the_normaliser_centres_and_scales_but_does_not_amplify_what_hardly_moves() -> None:
    context = normal(500, CONTEXT_DIM) * torch.tensor([5.0, 1.0, 1e-6, 0.0]) + 3
    network = ContextNetwork(CONTEXT_DIM, 2, (8,), "tanh", seed=0).double()
    network.normalise(context)
    assert torch.allclose(network.context_mean, context.mean(0))
    std = context.std(0, correction=0)
    assert torch.allclose(network.context_std, torch.stack([std[0], std[1], std[0] / 10, std[0] / 10]))
    network.normalise(torch.full((9, CONTEXT_DIM), 2.0, dtype=torch.float64))
    assert torch.equal(network.context_std, torch.ones(CONTEXT_DIM, dtype=torch.float64))


def test_svd_spans_the_leading_singular_vectors() -> None:
    actuation = normal(300, 2) @ normal(2, 7, seed=1) + 1e-3 * normal(300, 7, seed=2)
    batch = TensorDict({"actuation": actuation, "context": normal(300, 0)}, batch_size=300)
    map = nht.SVD(7, 2).double()
    assert map.fit(batch) is True
    best = torch.linalg.svdvals(actuation)[2:].square().sum() / 300
    assert torch.allclose(map.loss(batch), best)
    assert (map.frame.gather(0, map.frame.abs().argmax(0, keepdim=True)) > 0).all()


@pytest.mark.slow
@each_map
def test_maps_compile_into_one_graph(map: ActionMap) -> None:
    action, context = normal(8, map.action_dim), normal(8, CONTEXT_DIM, seed=1)
    actuation = torch.compile(map, fullgraph=True)(action, context)
    assert torch.allclose(actuation, map(action, context))
    assert torch.allclose(torch.compile(map.project, fullgraph=True)(actuation, context), action)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nht.NHT(4, 7, 8), "action_dim must be in 1 ... actuation_dim=7, got 8"),
        (lambda: nht.NHT(4, 7, 0), "action_dim must be in 1 ... actuation_dim=7, got 0"),
        (lambda: nht.SVD(7, 9), "action_dim must be in 1 ... actuation_dim=7, got 9"),
        (lambda: nht.NHT(4, 1, 1), "actuation_dim of at least 2, got 1"),
        (lambda: nht.NHT(0, 7, 2), "widths must be at least 1, got context_dim=0"),
        (lambda: nht.SVD(7, 2, -1), "context_dim must be 0 or more, got -1"),
        (lambda: nht.NHT(4, 7, 2, hidden=(16, 0)), r"hidden=\[16, 0\]"),
        (lambda: nht.NHT(4, 7, 2, hidden=(), multi_head=True), "need a hidden layer that they can have of"),
        (
            lambda: nht.NHT(4, 7, 2, activation="gelu"),
            "activation must be one of relu, sigmoid, tanh, got 'gelu'",
        ),
        (lambda: nht.NHT(4, 7, 2, lipschitz=0.0), "lipschitz must be a positive number or None, got 0.0"),
        (
            lambda: nht.NHT(4, 7, 2, lipschitz_norm="max"),
            "lipschitz_norm must be one of spectral, frobenius, got 'max'",
        ),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
