"""The interfaces that a person can choose from while a task runs: each is the task, driven through an action map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

import nht
from nht.recipes.maps.interface import trained_map
from nht.recipes.maps.kinds import KINDS, arm_of, find_kind, known_task, task_context_keys, tasks_with_arm
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig
from nht.transforms import ActionMapTransform
from nht.transforms.context import read_context

JOINTS = "joints"
"""Name of the interface that moves single joints."""
TEACHING_SPEED = 0.3
"""What an action of 1 is worth through the Jacobian: the tool's speed [m/s], and its turn [rad/s]."""


class Interface:
    """A running task, driven through one action map as training would drive it.

    Several interfaces may share one environment: the state is the environment's.

    Args:
        name: to show.
        map: what turns actions into actuations; it says what an action means.
        base: the task itself, one copy.
        env: which task that is, for what the map sees if its file does not say.

    Raises:
        KeyError, ValueError: if the map does not fit the task.

    Attributes:
        name: to show.
        map: the map, frozen.
        env: the task through the map, whose specs a policy is built for.
    """

    def __init__(self, name: str, map: nht.ActionMap, base: EnvBase, env: EnvConfig) -> None:
        untold = map.context_dim and map.context_keys is None
        self._transform = ActionMapTransform(map, task_context_keys(env) if untold else None)
        self.name = name
        self.env = TransformedEnv(base, self._transform)
        self.env.action_spec  # noqa: B018 - attaches the transform, which checks that the map fits
        self.map: nht.ActionMap = self._transform.map

    @property
    def action_dim(self) -> int:
        """Number of action axes k."""
        return self.map.action_dim

    def context(self, observed: TensorDictBase) -> Tensor:
        """What the map sees, ``(1, context_dim)``, in raw observations."""
        keys = self._transform.context_keys
        if not keys:
            return self.map.action_scale.new_zeros(1, 0)
        return read_context(observed, keys, self.map.action_scale.dtype)

    @torch.no_grad()
    def decode(self, action: Tensor, observed: TensorDictBase) -> Tensor:
        """The actuation for an action in [-1, 1]^k: scaled, offset and saturated as in training.

        Args:
            action: ``(1, k)``, or several for the one state, ``(A, k)``.
            observed: raw observations, ``(1,)``.

        Returns:
            ``(A, n)``.
        """
        context = self.context(observed).expand(len(action), -1)
        given = TensorDict({"action": action, "context": context}, batch_size=[len(action)])
        actuation: Tensor = self._transform.inv(given)["action"]
        return actuation

    def axis_effects(self, observed: TensorDictBase) -> Tensor:
        """Q as the motors feel it: the change of the actuation from action 0 to 1 on each axis, ``(n, k)``."""
        axes = torch.eye(self.action_dim)
        found = self.decode(torch.cat([torch.zeros(1, self.action_dim), axes]), observed)
        return (found[1:] - found[0]).T


def kind_name(map: nht.ActionMap) -> str:
    """The name of a map's kind in the table, or of its class; what turns or corrects a map does not count."""
    core = map
    while isinstance(core, nht.Residual | nht.Aligned):
        core = core.map
    names = [name for name in KINDS if KINDS.own(name) and KINDS[name].map_class is type(core)]
    return names[0] if names else type(core).__name__


def map_in_file(path: str, settings: MapConfig, allow: list[str]) -> nht.ActionMap:
    """The map in a file, with the scale and the saturation of ``settings``, where these are set.

    Raises:
        FileNotFoundError: if there is no such file; says how to make one.
        ValueError: if it holds no map.
    """
    if not Path(path).is_file():
        known = "" if Path(path).suffix else f", nor a kind of that name among {sorted(KINDS)}"
        raise FileNotFoundError(
            f"there is no map {path}{known}: train one, python -m nht.recipes.train_map map=nht out={path}."
        )
    map = nht.load_map(path, allow=[*settings.allow, *allow])
    if settings.saturation is not None:
        map.saturation = settings.saturation  # type: ignore[assignment]  # the setter checks it
    if settings.scale_is_set and settings.action_scale is not None:
        map.set_action_scale(settings.action_scale)
    return map


class Choices:
    """The interfaces of a task by name, made in the order in which they are to be shown.

    Args:
        base: the task itself, one copy.
        env: which task.
        settings: of the maps that are trained.
        demos: which demonstrations they are trained on.
        seed: of their training.
    """

    def __init__(
        self, base: EnvBase, env: EnvConfig, settings: MapConfig, demos: DemosConfig, seed: int
    ) -> None:
        self._base, self._env, self._settings, self._demos, self._seed = base, env, settings, demos, seed
        self.found: dict[str, Interface] = {}

    def add(self, name: str, map: nht.ActionMap, source: str = "") -> Interface:
        """Add an interface; a name that is taken gets a number.

        Args:
            name: to show.
            map: which map.
            source: its file or folder, for the message.

        Raises:
            ValueError: if the map does not fit the task; says how to train one that does.
        """
        own, number = name, 2
        while own in self.found:
            own, number = f"{name} {number}", number + 1
        try:
            self.found[own] = Interface(own, map, self._base, self._env)
        except (KeyError, TypeError, ValueError) as error:
            told = str(error.args[0]).removesuffix(".")
            raise ValueError(
                f"{source or f'the map {name}'} does not fit {self._env.name}: {told}. Train one that does: "
                f"python -m nht.recipes.train_map {_demonstrated(self._env)} map=nht out=runs/nht.safetensors."
            ) from error
        return self.found[own]

    def add_file(self, path: str, allow: list[str]) -> None:
        """Add the map in a file, named after its kind."""
        map = map_in_file(path, self._settings, allow)
        self.add(kind_name(map), map, path)

    def check_trainable(self, kinds: list[str]) -> None:
        """Raise ValueError for kinds that are unknown, or must be trained without demonstrations to train on."""
        learned = [kind for kind in kinds if find_kind(kind).needs_demos]
        if learned and self._demos.path is None:
            raise ValueError(
                f"{learned} are trained on demonstrations: name them, demos.path=FOLDER, or the maps' files. To record "
                f"some: python -m nht.recipes.collect_demos {_chosen(self._env)}, or by hand, on this page."
            )

    def train(self, kind: str) -> None:
        """Train a map of a kind on the demonstrations, and add it."""
        settings = replace(self._settings, kind=kind, file=None)
        self.add(kind, trained_map(settings, self._env, self._demos, self._seed).map)

    def add_teachers(self) -> None:
        """Add what needs no demonstrations: the Jacobian where an arm is known, and single joints."""
        for name, map in self._teachers():
            if name not in self.found:
                self.add(name, map)

    def _teachers(self) -> Iterator[tuple[str, nht.ActionMap]]:
        if self._env.suite == "nht" and self._env.name in tasks_with_arm():
            arm = arm_of(self._env.name)
            arm.set_action_scale(TEACHING_SPEED)
            arm.context_keys = find_kind("jacobian").context_keys
            yield "jacobian", arm
        yield JOINTS, nht.Identity(self._base.action_spec.shape[-1])


def _chosen(env: EnvConfig) -> str:
    """A task as it is chosen on a command line."""
    return f"env={env.name}" if env.suite == "nht" else f"env={env.suite} env.name={env.name}"


def _demonstrated(env: EnvConfig) -> str:
    """A task as ``train_map`` takes it: one without an expert needs a folder of demonstrations."""
    task = known_task(env)
    has_expert = task is not None and task.expert is not None
    return _chosen(env) if has_expert else f"{_chosen(env)} demos.path=FOLDER"
