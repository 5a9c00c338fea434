"""Corrections on top of every kind of map: nothing is out of reach, and nothing of the map is lost."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import nht
from nht.demos import Demos
from nht.maps import ActionMap
from nht.train import train_map

CONTEXT_DIM, N, K = 7, 7, 2


def inner_maps() -> list[ActionMap]:
    return [
        nht.NHT(CONTEXT_DIM, N, K, hidden=(8,)),
        nht.SCL(CONTEXT_DIM, N, K, hidden=(8,)),
        nht.SVD(N, K, CONTEXT_DIM),
        nht.LASER(CONTEXT_DIM, N, K, hidden=(8,)),
        nht.CAE(CONTEXT_DIM, N, K, hidden=(8,)),
        nht.JacobianPinv([0.1] * N, [1.0] * N, [0.2] * N),
        nht.Identity(N, CONTEXT_DIM),
    ]


each_map = pytest.mark.parametrize("inner", inner_maps(), ids=lambda map: type(map).__name__)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@each_map
def test_actuation_is_the_maps_plus_scaled_corrections(inner: ActionMap) -> None:
    map = nht.Residual(inner, 0.1)
    k = inner.action_dim
    assert (map.action_dim, map.actuation_dim, map.context_dim) == (k + N, N, CONTEXT_DIM)
    action, context = normal(3, 5, k + N), normal(3, 5, CONTEXT_DIM, seed=1)
    expected = inner(action[..., :k], context) + 0.1 * action[..., k:]
    assert torch.equal(map(action, context), expected)
    idle = torch.cat([action[..., :k], torch.zeros(3, 5, N)], dim=-1)
    assert torch.equal(map(idle, context), inner(action[..., :k], context))


@each_map
def test_every_actuation_is_reached_and_the_map_does_its_share(inner: ActionMap) -> None:
    map = nht.Residual(inner, 0.1)
    actuation, context = normal(30, N), normal(30, CONTEXT_DIM, seed=1)
    action = map.project(actuation, context)
    assert torch.allclose(map(action, context), actuation, atol=1e-5)
    assert torch.equal(action[:, : inner.action_dim], inner.project(actuation, context))


def test_corrections_of_a_linear_map_are_the_smallest() -> None:
    inner = nht.NHT(CONTEXT_DIM, N, K, hidden=(8,)).double()
    map = nht.Residual(inner, 0.1)
    actuation, context = normal(30, N).double(), normal(30, CONTEXT_DIM, seed=1).double()
    correction = 0.1 * map.project(actuation, context)[:, K:]
    assert torch.allclose(inner.project(correction, context), torch.zeros(30, K).double(), atol=1e-12)


@each_map
def test_saved_and_loaded_with_the_map_inside(inner: ActionMap, tmp_path: Path) -> None:
    inner = copy.deepcopy(inner)
    inner.context_keys = ("joint_angle",)
    inner.data_fingerprint = "abc"
    inner.action_scale.fill_(3)
    map = nht.Residual(inner, 0.1)
    loaded = nht.load_map(nht.save_map(map, tmp_path / "map.safetensors"))
    assert isinstance(loaded, nht.Residual)
    assert type(loaded.map) is type(inner)
    assert loaded.map.init_args() == inner.init_args()
    assert (loaded.scale, loaded.context_keys, loaded.data_fingerprint) == (0.1, ("joint_angle",), "abc")
    assert float(loaded.action_scale) == 3
    action, context = normal(4, map.action_dim), normal(4, CONTEXT_DIM)
    assert torch.equal(loaded(action, context), map(action, context))
    assert nht.certificate(loaded) == nht.certificate(inner)


def test_double_precision_is_kept(tmp_path: Path) -> None:
    map = nht.Residual(nht.NHT(CONTEXT_DIM, N, K).double(), 0.1)
    loaded = nht.load_map(nht.save_map(map, tmp_path / "map.safetensors"))
    assert {value.dtype for value in loaded.state_dict().values()} == {torch.float64}


def test_the_map_inside_is_trained_before() -> None:
    demos = Demos.from_tensors(
        actuation=normal(60, N),
        episode=torch.arange(6).repeat_interleave(10),
        context=normal(60, CONTEXT_DIM, seed=1),
    )
    inner = train_map(demos, nht.SVD(N, K, CONTEXT_DIM)).map
    map = nht.Residual(inner, 0.1)
    assert map.context_keys == ("context",)
    assert torch.equal(map.actuation_low, demos.actuation.amin(0))
    assert torch.equal(map.action_scale, inner.action_scale)
    with pytest.raises(ValueError, match="a Residual learns nothing: train its SVD, then wrap that"):
        train_map(demos, map)


@pytest.mark.parametrize("scale", [-0.1, 0.0, float("nan"), float("inf")])
def test_a_scale_that_is_not_positive(scale: float) -> None:
    with pytest.raises(ValueError, match=f"scale must be a positive number, got {scale}; for no corrections"):
        nht.Residual(nht.SVD(N, K), scale)


@pytest.mark.parametrize(
    ("inner", "name"), [(nht.Residual(nht.SVD(N, K), 0.1), "Residual"), (None, "NoneType")]
)
def test_what_cannot_be_corrected(inner: Any, name: str) -> None:
    with pytest.raises(TypeError, match=f"must be an action map without corrections, got {name}"):
        nht.Residual(inner, 0.1)
