"""The interface of a run: a map trained on demonstrations, one from a file, or the motors themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import gettempdir

import torch

import nht
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.kinds import (
    arm_of,
    default_scale,
    find_kind,
    make_map,
    map_context_keys,
    tasks_with_arm,
)
from nht.recipes.progress_bar import progress_bar
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig, Training
from nht.storage import format_version
from nht.writing import scratch

SCRATCH = "nht-demonstrations"
"""Name of what is recorded for one map alone, where temporary files are; the next run removes a killed one's."""


def trained_map(
    map: MapConfig,
    env: EnvConfig,
    demos: DemosConfig,
    seed: int,
    device: str = "cpu",
    *,
    align: str | None = None,
    watch: Callable[[dict[str, float]], None] | None = None,
) -> nht.MapTraining:
    """Train the map that ``map`` describes; without a folder of demonstrations, the expert records some.

    With ``align="tool"`` its axes are then turned to the motion of the arm's tool: 1 is along +x, 2 along +y, 3 along
    +z, on average over the demonstrations; 4, 5 and 6 turn it about x, y and z. ``watch`` is called with the metrics of
    every validation.

    Raises:
        ValueError: for an unknown kind of map, or demonstrations of another task; for an alignment without a known
            arm, or of a map that is not linear or has more than six axes.
    """
    keys = map_context_keys(map, env)
    with scratch(Path(gettempdir()) / SCRATCH) as place:
        if demos.path is None:
            place.mkdir(mode=0o700)
            data = record_expert(env, demos, seed, place / "demos")
        else:
            data = nht.load_demos(demos.path, env=env.name)
        context_dim = data.context(keys).shape[-1]
        untrained = make_map(map, context_dim, data.actuation.shape[-1], seed, env).to(device)
        if align is not None:
            _check_alignable(untrained, env.name)
        with progress_bar(map.max_steps, f"map {map.kind}", "step", unit_scale=True) as bar:

            def show(metrics: dict[str, float]) -> None:
                bar.set_postfix(error=f"{metrics['validation_error']:.2e}", refresh=False)
                bar.update(int(metrics["step"]) - bar.n)
                if watch is not None:
                    watch(metrics)

            trained = nht.train_map(
                data,
                untrained,
                context_keys=keys,
                batch_size=map.batch_size,
                learning_rate=map.learning_rate,
                max_steps=map.max_steps,
                seed=seed,
                progress=show,
            )
        finished = trained.map if align is None else _tool_aligned(trained.map, data, env.name)
    return _as_told(trained, finished, map)


def trained_maps(
    maps: Sequence[MapConfig], env: EnvConfig, demos: DemosConfig, seeds: Sequence[int]
) -> list[nht.MapTraining | FloatingPointError]:
    """Train maps of one kind together, each as ``train_map`` would alone.

    Args:
        maps: of one kind, number of actions and offset.
        env: the task.
        demos: the demonstrations, which are in a folder.
        seeds: of each map.

    Returns:
        What training gave, and for a map that diverged the error.

    Raises:
        ValueError: as ``train_map``.
    """
    keys = map_context_keys(maps[0], env)
    data = nht.load_demos(demos.path or "", env=env.name)
    widths = data.context(keys).shape[-1], data.actuation.shape[-1]
    untrained = [make_map(map, *widths, seed, env) for map, seed in zip(maps, seeds, strict=True)]
    made = len(maps) * [0]
    with progress_bar(
        sum(map.max_steps for map in maps), f"{len(maps)} maps {maps[0].kind}", "step", unit_scale=True
    ) as bar:

        def show(place: int, metrics: dict[str, float]) -> None:
            bar.update(int(metrics["step"]) - made[place])
            made[place] = int(metrics["step"])

        found = nht.train_maps(
            data,
            untrained,
            context_keys=keys,
            batch_size=[map.batch_size for map in maps],
            learning_rate=[map.learning_rate for map in maps],
            max_steps=[map.max_steps for map in maps],
            seed=list(seeds),
            progress=show,
        )
    return [
        each if isinstance(each, FloatingPointError) else _as_told(each, each.map, map)
        for each, map in zip(found, maps, strict=True)
    ]


def _as_told(trained: nht.MapTraining, map: nht.ActionMap, settings: MapConfig) -> nht.MapTraining:
    """What training gave, with the map as a run uses it."""
    finished = _configured(map, settings)
    return nht.MapTraining(finished, trained.metrics | {"action_scale": float(finished.action_scale)})


def _check_alignable(map: nht.ActionMap, task: str) -> None:
    if task not in (arms := tasks_with_arm()):
        raise ValueError(f"align=tool needs an arm's kinematics: {arms} have one, {task!r} does not.")
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


def _configured(map: nht.ActionMap, settings: MapConfig) -> nht.ActionMap:
    """The map with the corrections and the action scale of the settings, which are part of it from here on."""
    if settings.residual is not None and not isinstance(map, nht.Residual):
        map = nht.Residual(map, settings.residual)
    if settings.saturation is not None:
        map.saturation = settings.saturation  # type: ignore[assignment]  # the setter checks it
    if (scale := default_scale(settings)) is not None:
        map.set_action_scale(scale)
    return map


def map_from_file(settings: MapConfig) -> nht.ActionMap:
    """The map in ``map.file``, which must be of ``map.kind``; corrections are added if asked for.

    The file's action scale holds unless ``map.action_scale`` is set. Files of format version 1 get the default scale of
    the kind, as before.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is of another kind or has other corrections, as the run's name would be wrong.
    """
    path, kind = settings.file or "", find_kind(settings.kind)
    map = nht.load_map(path, allow=settings.allow)
    core = map
    if isinstance(map, nht.Residual):
        core = map.map
        if map.scale != settings.residual:
            raise ValueError(
                f"{path} holds a map with residual {map.scale}, but map.residual is {settings.residual}."
            )
    if isinstance(core, nht.Aligned):
        core = core.map
    if type(core) is not kind.map_class:
        raise ValueError(f"{path} holds a {type(core).__name__}, but map.kind is {settings.kind!r}.")
    scale = None if settings.scale_is_set or format_version(path) == 1 else float(map.action_scale)
    map = _configured(map, settings)
    if scale is not None:
        map.set_action_scale(scale)
    return map


def run_map(settings: Training, motors: int) -> nht.MapTraining:
    """The map that a run is told to use: the given file's, one trained on demonstrations, or the motors themselves.

    The result has the metrics of its training, if there was one. Raw actuation of a given scale needs no
    demonstrations.

    Args:
        settings: of the run.
        motors: n, of the task.

    Raises:
        FileNotFoundError, ValueError: if the given file holds no map, one of another kind, or one trained on other
            observations than ``env.context_keys`` names.
    """
    map, env = settings.map, settings.env
    if map.file is not None:
        loaded = map_from_file(map)
        said = find_kind(map.kind).context_keys or env.context_keys
        own = loaded.context_keys if loaded.context_dim else None
        if said is not None and own is not None and list(own) != list(said):
            raise ValueError(
                f"the map in {map.file} was trained on the observations {list(own)}, env.context_keys are {list(said)}."
            )
        return nht.MapTraining(loaded, {})
    if map.kind == "none" and map.residual is None and default_scale(map) is not None:
        return nht.MapTraining(_configured(nht.Identity(motors), map), {})
    return trained_map(map, env, settings.demos, settings.seed)


def number_of_actions(settings: Training, motors: int, context_dim: int) -> int:
    """The number of actions k of the map that a run will use, before it is trained.

    Args:
        settings: of the run.
        motors: n, of the task.
        context_dim: width of what the map sees there.

    Raises:
        FileNotFoundError, ValueError: if the given file holds no map or one of another kind, or for options that the
            kind does not have.
    """
    map = settings.map
    if map.file is not None:
        return map_from_file(map).action_dim
    width = make_map(map, context_dim, motors, settings.seed, settings.env).action_dim
    return width if map.residual is None else width + motors
