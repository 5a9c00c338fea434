"""Axes turned towards given directions: the best rotation there is, and nothing of the map is lost."""

from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

import nht
from nht.envs import make_env
from nht.envs.wam_kinematics import forward_kinematics
from nht.maps import ActionMap, LinearActionMap
from nht.recipes.config import TrainMap
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.interface import map_from_file, trained_map
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig
from nht.train import projection_error
from nht.transforms import ActionMapTransform

CONTEXT_DIM, N = 7, 7


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def orthogonal(size: int, seed: int) -> Tensor:
    """Any orthogonal matrix, turned or mirrored."""
    return torch.linalg.qr(normal(size, size, seed=seed)).Q


def inner_maps() -> list[LinearActionMap]:
    trained_svd = nht.SVD(N, 3, CONTEXT_DIM)
    trained_svd.fit(TensorDict({"actuation": normal(50, N)}, batch_size=50))
    maps = [
        *(nht.NHT(CONTEXT_DIM, N, k, hidden=(8,), seed=k) for k in (1, 2, 3)),
        nht.SCL(CONTEXT_DIM, N, 2, hidden=(8,)),
        trained_svd,
        nht.JacobianPinv([0.1] * N, [1.0] * N, [0.2] * N),
        nht.Identity(N, CONTEXT_DIM),
    ]
    return [map.double() for map in maps]


each_map = pytest.mark.parametrize(
    "inner", inner_maps(), ids=lambda map: f"{type(map).__name__}-{map.action_dim}"
)


def seeds(test: Any) -> Any:
    """Runs a test on some ten seeds."""
    return settings(max_examples=10)(given(seed=st.integers(0, 2**16))(test))


# Laws.


@each_map
@seeds
def test_lengths_span_error_and_certificate_stay(inner: LinearActionMap, seed: int) -> None:
    map = nht.Aligned(inner, orthogonal(inner.action_dim, seed))
    context, actuation = normal(4, 5, CONTEXT_DIM, seed=seed), normal(4, 5, N, seed=seed + 1)
    before, after = inner.basis(context), map.basis(context)
    torch.testing.assert_close(after @ after.mT, before @ before.mT)
    error = projection_error(inner, context.flatten(0, 1), actuation.flatten(0, 1))
    assert projection_error(map, context.flatten(0, 1), actuation.flatten(0, 1)) == pytest.approx(error)
    assert nht.certificate(map) == nht.certificate(inner)
    if isinstance(inner, nht.NHT | nht.SVD):
        torch.testing.assert_close(after.mT @ after, torch.eye(map.action_dim).double().expand(4, 5, -1, -1))


@each_map
@seeds
def test_forward_and_project_are_those_of_the_turned_basis(inner: LinearActionMap, seed: int) -> None:
    map = nht.Aligned(inner, orthogonal(inner.action_dim, seed))
    context, action = normal(4, 5, CONTEXT_DIM, seed=seed), normal(4, 5, map.action_dim, seed=seed + 1)
    actuation = map(action, context)
    torch.testing.assert_close(actuation, (map.basis(context) @ action.unsqueeze(-1)).squeeze(-1))
    if not isinstance(inner, nht.JacobianPinv):  # damped: it never gives the action back to the last digit
        torch.testing.assert_close(map.project(actuation, context), action)
    turned_back = map.project(actuation, context) @ map.rotation.mT
    torch.testing.assert_close(turned_back, inner.project(actuation, context))


@seeds
def test_no_orthogonal_matrix_agrees_better(seed: int) -> None:
    inner, tool, k = inner_maps()[2], normal(20, 6, N, seed=seed), 3
    context, directions = normal(20, CONTEXT_DIM, seed=seed + 1), normal(6, k, seed=seed + 2)

    moved = tool @ inner.basis(context)

    def missed(rotation: Tensor) -> Tensor:
        return (moved @ rotation - directions).square().mean()

    best = nht.align(inner, directions, context, jacobian=tool).rotation
    others = [orthogonal(k, other) for other in range(seed, seed + 30)]
    near = [best @ nudge(k, other) for other in range(10)]
    assert all(missed(best) < missed(other) for other in others + near)


def nudge(size: int, seed: int) -> Tensor:
    """A rotation by about 0.001 rad."""
    skew = 1e-3 * normal(size, size, seed=seed)
    return torch.linalg.matrix_exp(skew - skew.mT)


@each_map
@seeds
def test_what_was_turned_by_hand_is_turned_back(inner: LinearActionMap, seed: int) -> None:
    turned = nht.Aligned(inner, orthogonal(inner.action_dim, seed))
    context = normal(CONTEXT_DIM, seed=seed)
    again = nht.align(turned, inner.basis(context), context)
    assert again.map is inner  # aligned anew, not one rotation upon another
    torch.testing.assert_close(again.rotation, torch.eye(inner.action_dim).double(), atol=1e-6, rtol=0)


def test_a_jacobian_stands_for_actuations_along_its_rows() -> None:
    inner, context = inner_maps()[1], normal(20, CONTEXT_DIM)
    tool, directions = normal(20, 3, N, seed=1), normal(20, 3, 2, seed=2)
    by_tool = nht.align(inner, directions, context, jacobian=tool)
    by_motors = nht.align(inner, tool.mT @ directions, context)
    torch.testing.assert_close(by_tool.rotation, by_motors.rotation)
    one = nht.align(inner, directions[0], context[0], jacobian=tool[0])
    several = nht.align(inner, directions[0], context[:1].expand(5, -1), jacobian=tool[0])
    torch.testing.assert_close(one.rotation, several.rotation)


def test_an_axis_that_points_the_wrong_way_is_mirrored() -> None:
    map = nht.align(nht.SVD(2, 2).double(), torch.tensor([[1.0, 0], [0, -1]]), torch.zeros(0))
    assert map.rotation.tolist() == [[1, 0], [0, -1]]


# Together with the rest.


@each_map
def test_saved_and_loaded(inner: LinearActionMap, tmp_path: Path) -> None:
    inner.context_keys, inner.data_fingerprint = ("joint_angle",), "abc"
    map = nht.Aligned(inner, orthogonal(inner.action_dim, 0))
    corrected = nht.Residual(map, 0.1)
    context, action = normal(4, CONTEXT_DIM), normal(4, map.action_dim, seed=1)
    loaded = nht.load_map(nht.save_map(map, tmp_path / "map.safetensors"))
    assert isinstance(loaded, nht.Aligned)
    torch.testing.assert_close(loaded(action, context), map(action, context))  # memory layouts may differ
    assert (loaded.context_keys, loaded.data_fingerprint) == (("joint_angle",), "abc")
    inside = nht.load_map(nht.save_map(corrected, tmp_path / "corrected.safetensors"))
    idle = torch.cat([action, torch.zeros(4, N)], dim=-1)
    torch.testing.assert_close(inside(idle, context), map(action, context))
    assert nht.certificate(inside) == nht.certificate(loaded) == nht.certificate(inner)


def test_an_identity_until_told_otherwise_and_single_precision() -> None:
    inner = nht.NHT(CONTEXT_DIM, N, 2)
    map = nht.Aligned(inner)
    context = normal(4, CONTEXT_DIM).float()
    assert torch.equal(map.basis(context), inner.basis(context))
    aligned = nht.align(inner, normal(N, 2), context)
    assert {value.dtype for value in aligned.state_dict().values()} == {torch.float32}


def test_the_tool_follows_the_axes_of_a_map_trained_on_wam_wipe(tmp_path: Path) -> None:
    task = EnvConfig(context_keys=["tool_position", "joint_angle"], options={"start": "random"})
    demos = record_expert(task, DemosConfig(transitions=2000), 0, tmp_path / "demos")
    settings = MapConfig(hidden=[32], max_steps=500, action_scale=None)
    folder = DemosConfig(path=str(tmp_path / "demos"))
    plain = trained_map(settings, task, folder, 3).map
    aligned, metrics = trained_map(settings, task, folder, 3, align="tool")
    assert isinstance(aligned, nht.Aligned)
    assert metrics["action_scale"] == float(aligned.action_scale) != float(plain.action_scale)

    tool = forward_kinematics(demos.data["joint_angle"].double().numpy()).linear_jacobian()
    motion, before = (
        (torch.from_numpy(tool) @ map.basis(demos.context(task.context_keys)).double()).mean(0)
        for map in (aligned, plain)
    )
    assert torch.allclose(motion / motion.norm(dim=0), torch.eye(3, 2).double(), atol=0.2)
    assert not torch.allclose(before / before.norm(dim=0), torch.eye(3, 2).double(), atol=0.5)

    env = TransformedEnv(
        make_env("wam_wipe", num_envs=3, seed=0), ActionMapTransform(aligned, action_scale=0.5)
    )
    state = env.reset()
    after = env.step(state.set("action", torch.tensor([[1.0, 0.0]]).expand(3, -1)))["next"]
    moved = after["tool_position"] - state["tool_position"]
    assert (moved[:, 0] > 5 * moved[:, 1:].abs().amax(1)).all()

    corrected = nht.Residual(aligned, 0.1)
    for map in (aligned, corrected):  # what a run is told of its map's kind still holds
        file = nht.save_map(map, tmp_path / f"{type(map).__name__}.safetensors")
        assert type(map_from_file(MapConfig("nht", str(file), residual=0.1))) is nht.Residual
    found = map_from_file(MapConfig("nht", str(tmp_path / "Aligned.safetensors")))
    assert type(found) is nht.Aligned
    assert torch.equal(found.action_scale, aligned.action_scale)


# Bad input.


def test_an_aligned_map_learns_nothing() -> None:
    with pytest.raises(ValueError, match="an Aligned learns nothing: train its SVD, then align that"):
        nht.Aligned(nht.SVD(N, 2)).fit(TensorDict({}, batch_size=()))


LASER, CORRECTED = nht.LASER(CONTEXT_DIM, N, 2, hidden=(8,)), nht.Residual(nht.SVD(N, 2), 0.1)


@pytest.mark.parametrize("map", [LASER, CORRECTED, None, nht.Aligned(nht.SVD(N, 2))])
def test_what_cannot_be_wrapped(map: Any) -> None:
    with pytest.raises(TypeError, match=f"a linear action map, not yet aligned, got {type(map).__name__}"):
        nht.Aligned(map)


@pytest.mark.parametrize("map", [LASER, CORRECTED])
def test_what_has_no_axes(map: ActionMap) -> None:
    with pytest.raises(TypeError, match=f"linear in the action has axes to turn, got {type(map).__name__}"):
        nht.align(map, torch.eye(N, 2), torch.zeros(CONTEXT_DIM))


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (torch.eye(3), r"rotation must have shape \(2, 2\), got \(3, 3\)"),
        (torch.tensor([[1.0, 0.1], [0.0, 1.0]]), r"must be orthogonal, but an entry of R\^T R - I is 0\.1"),
        (torch.full((2, 2), torch.nan), r"must be orthogonal, but an entry of R\^T R - I is nan"),
    ],
)
def test_a_rotation_that_is_none(rotation: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        nht.Aligned(nht.SVD(N, 2), rotation)


@pytest.mark.parametrize(
    ("directions", "context", "jacobian", "message"),
    [
        ((N, 3), (5, 7), None, r"directions must be \(7, 2\), or one .* got \(7, 3\) for contexts \(5, 7\)"),
        ((4, N, 2), (5, 7), None, r"directions must be \(7, 2\), or one .* got \(4, 7, 2\)"),
        ((N, 2), (5, 7), (3, N), r"directions must be \(3, 2\), or one .* got \(7, 2\)"),
        ((N, 2), (5, 6), None, r"context must be \(7,\) or \(T, 7\), got \(5, 6\)"),
        ((N, 2), (0, 7), None, r"context must be \(7,\) or \(T, 7\), got \(0, 7\)"),
        ((N, 2), (2, 5, 7), None, r"context must be \(7,\) or \(T, 7\), got \(2, 5, 7\)"),
        ((3, 2), (5, 7), (3, 6), r"jacobian must be \(m, 7\), or one .* got \(3, 6\) for contexts \(5, 7\)"),
        ((3, 2), (5, 7), (4, 3, N), r"jacobian must be \(m, 7\), or one .* got \(4, 3, 7\)"),
        ((3, 2), (5, 7), (N,), r"jacobian must be \(m, 7\), or one .* got \(7,\)"),
    ],
)
def test_shapes_that_do_not_fit(
    directions: tuple[int, ...], context: tuple[int, ...], jacobian: tuple[int, ...] | None, message: str
) -> None:
    map = nht.NHT(CONTEXT_DIM, N, 2, hidden=(8,)).double()
    with pytest.raises(ValueError, match=message):
        nht.align(
            map, normal(*directions), normal(*context), jacobian=normal(*jacobian) if jacobian else None
        )


@pytest.mark.parametrize(
    ("directions", "rank"),
    [
        (torch.zeros(N, 2), 0),
        (torch.ones(N, 2), 1),  # not independent
        (torch.eye(N, 3)[:, [0, 2]], 1),  # the second is orthogonal to what the map spans
        (torch.stack([torch.eye(N, 2), -torch.eye(N, 2)]), 0),  # opposite in two contexts
    ],
)
def test_directions_that_leave_a_rotation_open(directions: Tensor, rank: int) -> None:
    with pytest.raises(
        ValueError, match=f"the directions determine {rank} of the 2 axes: they must be indep"
    ):
        nht.align(nht.SVD(N, 2), directions, torch.zeros(2, 0))


@pytest.mark.parametrize(
    ("kind", "k", "task", "message"),
    [
        ("nht", 2, "half_cheetah", r"an arm's kinematics: \['wam.*'half_cheetah' does not"),
        ("laser", 2, "wam_wipe", "needs a linear map of at most 6 axes, got LASER with 2"),
        ("none", 7, "wam_wipe", "needs a linear map of at most 6 axes, got Identity with 7"),
    ],
)
def test_an_alignment_to_the_tool_that_cannot_be_is_refused_before_training(
    kind: str, k: int, task: str, message: str, tmp_path: Path
) -> None:
    nht.save_demos(
        TensorDict(
            {"actuation": normal(6, N), "episode": torch.arange(6) // 3, "c": normal(6, 1)}, batch_size=6
        ),
        tmp_path / "demos",
        env=task,
        seed=0,
        expert="none",
    )
    demos, env = DemosConfig(path=str(tmp_path / "demos")), EnvConfig(name=task, context_keys=["c"])
    with pytest.raises(ValueError, match=message):
        trained_map(MapConfig(kind=kind, action_dim=k, max_steps=10**9), env, demos, 0, align="tool")
    with pytest.raises(ValueError, match="align must be tool, or null for axes as they come out, got 'x'"):
        TrainMap(align="x")
