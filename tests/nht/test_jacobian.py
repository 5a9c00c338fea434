"""The Jacobian map agrees with MuJoCo's Jacobian, does what its action says, and stays bounded where that is lost."""

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

import nht
from nht.demos import Demos
from nht.envs import wam_kinematics as wam
from nht.envs.models import ASSETS
from nht.train import train_map


def wam_map(damping: float = 0.01) -> nht.JacobianPinv:
    twists = (wam.QUARTER_TURNS * math.pi / 2).tolist()
    return nht.JacobianPinv(wam.A.tolist(), twists, wam.D.tolist(), damping)


def postures(count: int) -> Tensor:
    low, high = torch.from_numpy(wam.JOINT_LOW), torch.from_numpy(wam.JOINT_HIGH)
    share = torch.rand(count, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return low + share * (high - low)


def velocities(count: int, width: int) -> Tensor:
    return torch.randn(count, width, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def smallest_singular_value(joint_angle: Tensor) -> Tensor:
    return torch.linalg.svdvals(wam_map().jacobian(joint_angle))[:, -1]


def test_the_jacobian_is_mujocos() -> None:
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "wam_wipe.xml"))
    data, site = mujoco.MjData(model), model.site("tool").id
    joint_angle = postures(200)
    found = wam_map().double().jacobian(joint_angle).numpy()
    for row, angles in enumerate(joint_angle.numpy()):
        data.qpos[:7] = angles
        mujoco.mj_forward(model, data)
        expected = np.empty((6, model.nv))
        mujoco.mj_jacSite(model, data, expected[:3], expected[3:], site)
        assert np.abs(found[row] - expected[:, :7]).max() < 1e-6


def test_single_precision_is_good_to_a_micrometre() -> None:
    joint_angle = postures(200)
    single = wam_map().jacobian(joint_angle.float())
    assert single.dtype == torch.float32
    assert (single - wam_map().jacobian(joint_angle)).abs().max() < 2e-6


def test_any_dh_chain_agrees_with_finite_differences() -> None:
    """Twists that are no quarter turns, and eight joints: the tool's path by homogeneous transforms."""
    generator = torch.Generator().manual_seed(3)
    lengths, twists, offsets, angles = torch.rand(4, 8, generator=generator, dtype=torch.float64)

    def tool(q: Tensor) -> Tensor:
        pose = torch.eye(4, dtype=torch.float64)
        for angle, length, twist, offset in zip(q, lengths, twists, offsets, strict=True):
            c, s, ca, sa = angle.cos(), angle.sin(), twist.cos(), twist.sin()
            zero, one = torch.zeros_like(c), torch.ones_like(c)
            rows = [
                torch.stack([c, -s * ca, s * sa, length * c]),
                torch.stack([s, c * ca, -c * sa, length * s]),
                torch.stack([zero, sa, ca, offset]),
                torch.stack([zero, zero, zero, one]),
            ]
            pose = pose @ torch.stack(rows)
        return pose

    slopes = torch.autograd.functional.jacobian(tool, angles)  # (4, 4, 8)
    turning = torch.einsum("ijq,kj->qik", slopes[:3, :3], tool(angles)[:3, :3])  # dR R^T, skew
    angular = torch.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]])
    found = nht.JacobianPinv(lengths.tolist(), twists.tolist(), offsets.tolist()).jacobian(angles)
    assert torch.allclose(found, torch.cat([slopes[:3, 3], angular]), atol=1e-12)


def test_the_tool_moves_as_the_action_says() -> None:
    joint_angle = postures(500)
    regular = joint_angle[smallest_singular_value(joint_angle) > 0.1]
    assert len(regular) > 100
    map, action = wam_map().double(), velocities(len(regular), 6)
    actuation = map(action, regular)
    assert (map.project(actuation, regular) - action).norm(dim=-1).max() < 0.02 * action.norm(dim=-1).max()
    undamped = wam_map(1e-6).double()
    assert torch.allclose(undamped.project(undamped(action, regular), regular), action, atol=1e-8)


def test_forward_and_basis_are_the_pseudo_inverse() -> None:
    map, joint_angle, action = wam_map(1e-6).double(), postures(20), velocities(20, 6)
    inverse = torch.linalg.pinv(map.jacobian(joint_angle))
    assert torch.allclose(map.basis(joint_angle), inverse, rtol=1e-5, atol=1e-6)
    assert torch.allclose(map(action, joint_angle), (inverse @ action.unsqueeze(-1)).squeeze(-1), rtol=1e-4)
    damped = wam_map(0.1).double()
    by_basis = (damped.basis(joint_angle) @ action.unsqueeze(-1)).squeeze(-1)
    assert torch.allclose(damped(action, joint_angle), by_basis)


@pytest.mark.parametrize("damping", [1e-2, 1e-1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_damping_bounds_the_joint_velocity_at_singular_postures(damping: float, dtype: torch.dtype) -> None:
    singular = torch.zeros(7, dtype=dtype)  # stretched out
    random = postures(500).to(dtype)
    assert smallest_singular_value(torch.zeros(1, 7, dtype=torch.float64)) < 1e-9
    for joint_angle in (singular, random):
        largest = torch.linalg.matrix_norm(wam_map(damping).basis(joint_angle), ord=2).max()
        assert float(largest) <= 1.01 / (2 * damping)
    joint_angle = singular.clone().requires_grad_()
    wam_map(damping)(torch.ones(6, dtype=dtype), joint_angle).sum().backward()
    assert joint_angle.grad is not None
    assert joint_angle.grad.isfinite().all()


def test_it_is_saved_loaded_and_trained_like_any_map(tmp_path: Path) -> None:
    joint_angle = postures(60).float()
    demos = Demos.from_tensors(
        actuation=velocities(60, 7)
        .float()[:, :1]
        .expand(-1, 7)
        .contiguous(),  # rank 1 will do: nothing is learned
        episode=torch.arange(6).repeat_interleave(10),
        context={"joint_angle": joint_angle},
    )
    map, metrics = train_map(demos, wam_map(0.05), context_keys=["joint_angle"])
    assert (metrics["steps"], metrics["certificate"]) == (0, math.inf)
    assert 0 < metrics["validation_error"] < 1
    loaded = nht.load_map(nht.save_map(map, tmp_path / "map.safetensors"))
    assert loaded.init_args() == map.init_args()
    assert loaded.context_keys == ("joint_angle",)
    action = velocities(60, 6).float()
    assert torch.equal(loaded(action, joint_angle), map(action, joint_angle))


@pytest.mark.slow
def test_it_compiles_into_one_graph() -> None:
    map, joint_angle, action = wam_map().double(), postures(8), velocities(8, 6)
    compiled = torch.compile(map, fullgraph=True)
    assert torch.allclose(compiled(action, joint_angle), map(action, joint_angle))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nht.JacobianPinv([0.1] * 5, [0.0] * 5, [0.0] * 5), "at least 6 each .* got 5, 5 and 5"),
        (
            lambda: nht.JacobianPinv([0.1] * 7, [0.0] * 6, [0.0] * 7),
            "one number per joint, .* got 7, 6 and 7",
        ),
        (lambda: wam_map(0.0), r"damping must be a positive number, got 0\.0"),
        (lambda: wam_map(-1.0), r"damping must be a positive number, got -1\.0"),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
