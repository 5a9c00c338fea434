"""An action map from demonstrations.

python -m nht.recipes.train_map map=nht demos.path=runs/demos-wam_wipe
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import torch
from tqdm import tqdm

import nht
from nht.envs import wam_kinematics
from nht.networks import Activation
from nht.recipes.config import DemosConfig, EnvConfig, MapConfig, TrainMap
from nht.recipes.data.recording import record_expert
from nht.recipes.launch import launch

KINDS: dict[str, type[nht.ActionMap]] = {
    "nht": nht.NHT,
    "scl": nht.SCL,
    "laser": nht.LASER,
    "cae": nht.CAE,
    "svd": nht.SVD,
    "jacobian": nht.JacobianPinv,
    "none": nht.Identity,
}
"""Every kind of map by the name that configurations use."""

ARMS = {"wam_grasp": wam_kinematics, "wam_wipe": wam_kinematics}
"""The kinematics of every task that is done by an arm with known ones."""


def main(config: TrainMap) -> None:
    """Train a map, save it and say how well it fits."""
    out = Path(config.out)
    if out.exists():
        raise FileExistsError(f"{out} exists: maps are never overwritten. Choose another file.")
    trained = train_map(config.map, config.env, config.demos, config.seed, config.device, align=config.align)
    nht.save_map(trained.map, out)
    for name, value in trained.metrics.items():
        print(f"{name:>20}  {value:.6g}")
    print(f"saved in {out}")


def train_map(
    map: MapConfig,
    env: EnvConfig,
    demos: DemosConfig,
    seed: int,
    device: str = "cpu",
    *,
    align: str | None = None,
) -> nht.MapTraining:
    """Train the map that ``map`` describes; without a folder of demonstrations the expert gives them.

    With ``align="tool"`` its axes are then turned to the motion of the arm's tool: 1 is along +x, 2 along +y, 3 along
    +z, on average over the demonstrations; 4, 5 and 6 turn it about x, y and z.

    Raises:
        ValueError: for an unknown kind of map, or demonstrations of another task; for an alignment without a known
            arm, or of a map that is not linear or has more than six axes.
    """
    with TemporaryDirectory() as scratch:
        if demos.path is None:
            data = record_expert(env, demos, seed, Path(scratch) / "demos")
        else:
            data = nht.load_demos(demos.path, env=env.name)
        context_dim = data.context(env.context_keys).shape[-1]
        untrained = make_map(map, context_dim, data.actuation.shape[-1], seed, env).to(device)
        if align is not None:
            _check_alignable(untrained, env.name)
        with tqdm(total=map.max_steps, desc=f"map {map.kind}", unit="step", unit_scale=True) as bar:

            def show(metrics: dict[str, float]) -> None:
                bar.set_postfix(error=f"{metrics['validation_error']:.2e}", refresh=False)
                bar.update(int(metrics["step"]) - bar.n)

            trained = nht.train_map(
                data,
                untrained,
                context_keys=env.context_keys,
                batch_size=map.batch_size,
                learning_rate=map.learning_rate,
                max_steps=map.max_steps,
                seed=seed,
                progress=show,
            )
        finished = trained.map if align is None else _tool_aligned(trained.map, data, env.name)
    metrics = trained.metrics | {"action_scale": float(finished.action_scale)}
    return nht.MapTraining(_with_corrections(finished, map.residual), metrics)


def make_map(
    map: MapConfig, context_dim: int, actuation_dim: int, seed: int, env: EnvConfig | None = None
) -> nht.ActionMap:
    """The untrained map of a kind.

    Args:
        map: which kind, and its options.
        context_dim: width of the context.
        actuation_dim: n.
        seed: of the initial weights.
        env: the task; only the kind "jacobian" asks what arm it has.

    Raises:
        ValueError: for an unknown kind; the message lists those that exist. For a Lipschitz limit or several heads
            that the kind cannot have, or a Jacobian where there is no arm.
    """
    _check_kind(map.kind)
    if map.kind == "none":
        return nht.Identity(actuation_dim, context_dim=context_dim)
    if map.kind == "svd":
        return nht.SVD(actuation_dim, map.action_dim, context_dim=context_dim)
    if map.kind == "jacobian":
        return _jacobian(env or EnvConfig(name="unknown"))
    sizes = (context_dim, actuation_dim, map.action_dim, map.hidden, cast(Activation, map.activation))
    if map.lipschitz is not None and map.kind in ("laser", "cae"):
        raise ValueError(f"map.lipschitz limits nht and scl, there is no limit for {map.kind!r}.")
    if map.multi_head and map.kind != "nht":
        raise ValueError(f"map.multi_head is an option of nht, {map.kind!r} has no heads.")
    if map.kind == "laser":
        return nht.LASER(*sizes, beta_kl=map.beta_kl, beta_dynamics=map.beta_dynamics, seed=seed)
    if map.kind == "cae":
        return nht.CAE(*sizes, seed=seed)
    make = nht.SCL if map.kind == "scl" else partial(nht.NHT, multi_head=map.multi_head)
    limit = map.lipschitz
    if limit is not None and map.lipschitz_per_layer:  # constants of a composition multiply
        limit = make(*sizes).network_gain * limit ** (len(map.hidden) + 1)
    return make(*sizes, lipschitz=limit, seed=seed)


def _jacobian(env: EnvConfig) -> nht.JacobianPinv:
    if env.name not in ARMS:
        raise ValueError(
            f"map.kind 'jacobian' needs an arm's kinematics: {sorted(ARMS)} have one, {env.name!r} does not."
        )
    if env.context_keys != ["joint_angle"]:
        raise ValueError(
            f"map.kind 'jacobian' needs env.context_keys=[joint_angle], as map=jacobian sets, got {env.context_keys}."
        )
    return arm_of(env.name)


def arm_of(task: str) -> nht.JacobianPinv:
    """How the joints of a task's arm move its tool; ``task`` must be one of ``ARMS``."""
    arm = ARMS[task]
    return nht.JacobianPinv(arm.A.tolist(), (arm.QUARTER_TURNS * math.pi / 2).tolist(), arm.D.tolist())


def _check_alignable(map: nht.ActionMap, task: str) -> None:
    if task not in ARMS:
        raise ValueError(f"align=tool needs an arm's kinematics: {sorted(ARMS)} have one, {task!r} does not.")
    if not isinstance(map, nht.LinearActionMap) or map.action_dim > 6:
        raise ValueError(
            f"align=tool needs a linear map of at most 6 axes, got {type(map).__name__} with {map.action_dim}."
        )


@torch.no_grad()
def _tool_aligned(map: nht.ActionMap, demos: nht.Demos, task: str) -> nht.ActionMap:
    assert isinstance(map, nht.LinearActionMap)
    context, joint_angle, actuation = (
        value.to(map.action_scale)
        for value in (demos.context(map.context_keys or ()), demos.data["joint_angle"], demos.actuation)
    )
    directions = torch.eye(6, map.action_dim)
    aligned = nht.align(map, directions, context, jacobian=arm_of(task).jacobian(joint_angle))
    aligned.action_scale.copy_(aligned.project(actuation, context).abs().max())
    return aligned


def load_kind(path: str | Path, kind: str, residual: float | None = None) -> nht.ActionMap:
    """The map in a file, which must be of the given kind; with corrections, if asked for, that it may or may not have.

    Raises:
        ValueError: if it is of another kind or has other corrections, for a run would carry the wrong name.
    """
    _check_kind(kind)
    map = nht.load_map(path)
    core = map
    if isinstance(map, nht.Residual):
        core = map.map
        if map.scale != residual:
            raise ValueError(f"{path} holds a map with residual {map.scale}, but map.residual is {residual}.")
    if isinstance(core, nht.Aligned):
        core = core.map
    if type(core) is not KINDS[kind]:
        raise ValueError(f"{path} holds a {type(core).__name__}, but map.kind is {kind!r}.")
    return map if isinstance(map, nht.Residual) else _with_corrections(map, residual)


def _with_corrections(map: nht.ActionMap, residual: float | None) -> nht.ActionMap:
    return map if residual is None else nht.Residual(map, residual)


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise ValueError(f"unknown map kind {kind!r}: choose from {sorted(KINDS)}.")


if __name__ == "__main__":
    launch(main, TrainMap, "train_map")
