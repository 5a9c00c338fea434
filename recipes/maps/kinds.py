"""The table of kinds of action maps, and the untrained map of a kind."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import nht
from nht.envs import TASKS, Arm
from nht.envs.registry import TaskRecord, find_task
from nht.envs.table import Table
from nht.reading import shortened
from nht.recipes.sections import DEFAULT_SCALE, EnvConfig, MapConfig

NETWORK_SETTINGS = ("hidden", "activation", "multi_head", "start", "lipschitz", "beta_kl", "beta_dynamics")
"""Settings of ``map`` that shape networks: a kind without a network ignores them."""
SETTINGS = (*NETWORK_SETTINGS, "offset")
"""Settings of ``map`` that are passed to a kind's constructor if it takes arguments of these names."""


@dataclass(frozen=True)
class MapKind:
    """The record of a kind of map.

    Attributes:
        map_class: its class.
        build: makes an untrained one; the class itself by default. It gets what its signature asks for by name, out of
            ``context_dim``, ``actuation_dim``, ``action_dim``, ``seed``, ``arm`` (an ``Arm``), the settings of
            ``map`` that shape networks, and ``map.args``.
        action_scale: default of what an action of 1 stands for; None is the demonstrations' largest action, for kinds
            whose actions have units of their own.
        context_keys: the observations that it needs, whatever the task says; None leaves that to the task.
        needs_arm: whether the task must be done by a known arm.
        needs_demos: whether it must be trained on demonstrations.
        fixed_width: whether its number of actions is not ``map.action_dim`` but its own.
        colour: in figures; None derives one from its name.
    """

    map_class: type[nht.ActionMap]
    build: Callable[..., nht.ActionMap] | None = None
    action_scale: float | None = 1.0
    context_keys: tuple[str, ...] | None = None
    needs_arm: bool = False
    needs_demos: bool = True
    fixed_width: bool = False
    colour: str | None = None


def _jacobian(arm: Arm, damping: float = 0.01) -> nht.ActionMap:
    return nht.JacobianPinv(arm.lengths, arm.twists, arm.offsets, damping)


def _identity(actuation_dim: int, context_dim: int) -> nht.ActionMap:
    return nht.Identity(actuation_dim, context_dim=context_dim)


def _adopt(name: str, found: Any) -> MapKind:
    if isinstance(found, MapKind):
        return found
    if isinstance(found, type) and issubclass(found, nht.ActionMap):
        return MapKind(found)
    raise TypeError(f"the kind of map {name!r} must be a MapKind or an nht.ActionMap, got {found!r}.")


KINDS: Table[MapKind] = Table(
    "nht.maps",
    {
        "nht": MapKind(nht.NHT, colour="#0072B2"),
        "scl": MapKind(nht.SCL, action_scale=None, colour="#CC79A7"),
        "laser": MapKind(nht.LASER, action_scale=None, colour="#E69F00"),
        "cae": MapKind(nht.CAE, action_scale=None, colour="#D55E00"),
        "svd": MapKind(nht.SVD, colour="#009E73"),
        "jacobian": MapKind(
            nht.JacobianPinv,
            _jacobian,
            context_keys=("joint_angle",),
            needs_arm=True,
            fixed_width=True,
            colour="#56B4E9",
        ),
        "none": MapKind(nht.Identity, _identity, needs_demos=False, fixed_width=True, colour="#666666"),
    },
    _adopt,
)
"""Every kind of map by the name that configurations use; packages add theirs as entry points ``nht.maps``.

The colours are Okabe and Ito's, which the colour-blind can tell apart.
"""


def find_kind(name: str) -> MapKind:
    """The record of a kind.

    Args:
        name: a key of ``KINDS``, or an import path, ``"my_package.maps:TwoSided"``.

    Raises:
        ValueError: for an unknown name; the message lists those that exist.
    """
    if name not in KINDS:
        raise ValueError(
            f"unknown map kind {name!r}: choose from {sorted(KINDS)}, or name an import path, package.module:Class."
        )
    try:
        return KINDS[name]
    except (ImportError, TypeError) as error:
        raise ValueError(f"the map kind {name!r} cannot be found: {shortened(error)}.") from error


def kind_in_file_name(kind: str) -> str:
    """A kind's name as part of a file's."""
    return kind.replace(":", ".")


def known_task(env: EnvConfig) -> TaskRecord | None:
    """The record of the task that ``env`` names, if it is one of the table of tasks."""
    return find_task(env.name) if env.suite == "nht" and env.name in TASKS else None


def task_context_keys(env: EnvConfig) -> list[str]:
    """The observations that a map sees in a task: those of ``env.context_keys``, or else what the task says."""
    if env.context_keys is not None:
        return env.context_keys
    task = known_task(env)
    return list(task.context_keys) if task is not None else ["observation"]


def map_context_keys(map: MapConfig, env: EnvConfig) -> list[str]:
    """The observations that this map sees in a task: those that its kind needs, or else the task's."""
    needed = find_kind(map.kind).context_keys
    return list(needed) if needed is not None else task_context_keys(env)


def default_scale(map: MapConfig) -> float | None:
    """The action scale of the configuration: a number, or None for the demonstrations' largest action."""
    return find_kind(map.kind).action_scale if map.action_scale == DEFAULT_SCALE else map.action_scale


def arm_of(task: str) -> nht.JacobianPinv:
    """The Jacobian map of a task's arm.

    Raises:
        ValueError: if the task has no known arm; the message lists those that have one.
    """
    arm = find_task(task).kinematics if task in TASKS else None
    if arm is None:
        raise ValueError(f"{task!r} is not done by an arm of known kinematics: {tasks_with_arm()} are.")
    return nht.JacobianPinv(arm.lengths, arm.twists, arm.offsets)


def tasks_with_arm() -> list[str]:
    """The names of the tasks that are done by an arm of known kinematics."""
    return sorted(name for name in TASKS if TASKS[name].arm is not None)


def make_map(
    map: MapConfig, context_dim: int, actuation_dim: int, seed: int, env: EnvConfig | None = None
) -> nht.ActionMap:
    """The untrained map of a kind.

    Args:
        map: which kind, and its options.
        context_dim: width of the context.
        actuation_dim: n.
        seed: of the initial weights.
        env: the task; only a kind that needs an arm asks for it.

    Raises:
        ValueError: for an unknown kind, for options that the kind does not have or does not take, and for a kind that
            needs an arm where there is none.
    """
    kind = find_kind(map.kind)
    given: dict[str, Any] = {
        "context_dim": context_dim,
        "actuation_dim": actuation_dim,
        "action_dim": map.action_dim,
        "seed": seed,
    }
    given |= {name: getattr(map, name) for name in SETTINGS} | map.args
    build = kind.build or kind.map_class
    taken = inspect.signature(build).parameters
    if kind.needs_arm:
        given["arm"] = _arm(map, env)
    _check_options(map, list(taken))
    arguments = {name: value for name, value in given.items() if name in taken}
    if map.lipschitz is not None and map.lipschitz_per_layer and "lipschitz" in taken:
        gain = _unlimited_gain(build, arguments)
        arguments["lipschitz"] = gain * map.lipschitz ** (len(map.hidden) + 1)  # constants multiply
    try:
        return build(**arguments)
    except TypeError as error:
        raise ValueError(
            f"map.kind {map.kind!r} cannot be built from {sorted(arguments)}: {shortened(error)}."
        ) from error


def _unlimited_gain(build: Callable[..., nht.ActionMap], arguments: dict[str, Any]) -> float:
    """The Lipschitz constant from the network's output to the basis."""
    map = build(**arguments | {"lipschitz": None})
    assert isinstance(map, nht.LinearActionMap)
    return map.network_gain


def _check_options(map: MapConfig, taken: list[str]) -> None:
    """Raise for options that the kind does not have; a kind without a network ignores those that shape networks."""
    if unknown := sorted(map.args.keys() - taken):
        raise ValueError(f"map.args {unknown} are not arguments of {map.kind!r}, which takes {taken}.")
    asked = SETTINGS if "hidden" in taken else SETTINGS[len(NETWORK_SETTINGS) :]
    unset = {entry.name: entry.default for entry in fields(MapConfig)}
    for name in asked:
        if name not in taken and getattr(map, name) != unset[name] and name not in ("hidden", "activation"):
            having = [kind for kind in KINDS if name in inspect.signature(KINDS[kind].map_class).parameters]
            raise ValueError(f"map.{name} is an option of {' and '.join(having)}, not of {map.kind!r}.")


def _arm(map: MapConfig, env: EnvConfig | None) -> Arm:
    task = None if env is None else known_task(env)
    arm = None if task is None else task.kinematics
    if arm is None:
        name = "an unknown task" if env is None else repr(env.name)
        raise ValueError(
            f"map.kind {map.kind!r} needs a task done by an arm of known kinematics: {tasks_with_arm()} are, {name} "
            "is not."
        )
    return arm
