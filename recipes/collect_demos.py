r"""Demonstrations from a task's scripted expert, a trained policy, or others' files.

python -m nht.recipes.collect_demos env=wam_wipe demos.transitions=20000 out=runs/demos
python -m nht.recipes.collect_demos source=policy source.path=runs/ddpg-wam_wipe-nht-seed0 out=runs/policy-demos
python -m nht.recipes.collect_demos source=minari source.path=D4RL/door/human-v2 env.name=AdroitHandDoor \
    'env.context_keys=[observation]' out=runs/door-demos
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

from torchrl.envs.utils import ExplorationType, set_exploration_type

import nht
from nht.envs import make_env, make_expert
from nht.reading import naming
from nht.recipes.agents.policy import load_policy
from nht.recipes.config import CollectDemos
from nht.recipes.data.answers import EXPERT_ACTION, Controller, shared_driving
from nht.recipes.data.files import FILES, best_episodes, read_episodes
from nht.recipes.data.recording import COPIES, endings, has_success, record_episodes, record_expert
from nht.recipes.launch import launch
from nht.recipes.maps.kinds import known_task, task_context_keys
from nht.recipes.run.environments import mapped_env
from nht.recipes.run.saved_run import kept_map, read_config
from nht.recipes.sections import DemosConfig, EnvConfig, SourceConfig


def main(config: CollectDemos) -> None:
    """Collect and save demonstrations, and print a summary."""
    if Path(config.out).exists():
        raise FileExistsError(
            f"{config.out} exists: demonstrations are never overwritten. Choose another folder."
        )
    demos = _collect(config)
    lengths = demos.episode.bincount()
    print(
        f"{len(demos):,} transitions in {len(lengths):,} episodes of {float(lengths.float().mean()):.0f} steps on "
        f"average; {demos.manifest['settings']['left_out_episodes']:,} episodes left out\nsaved in {config.out}"
    )


def _collect(config: CollectDemos) -> nht.Demos:
    source = config.source
    if source.kind == "expert":
        return record_expert(config.env, config.demos, config.seed, config.out)
    if source.kind == "policy":
        return record_policy(
            source.path, config.env, config.demos, config.seed, config.out, source.allow, source.relabel
        )
    if source.kind in FILES:
        return import_demos(source, config.env, config.demos.min_return, config.out)
    raise ValueError(f"unknown source.kind {source.kind!r}: choose from {['expert', 'policy', *FILES]}.")


def record_policy(
    run: str | None,
    env: EnvConfig,
    demos: DemosConfig,
    seed: int,
    path: str | Path,
    allow: Sequence[str] = (),
    relabel: bool = False,
) -> nht.Demos:
    """Record demonstrations of a finished run's policy, without exploration: the actuations that its map gives.

    The task's options are those of the run, but its episodes end at success and failure. Kept are successful episodes,
    if the task has a notion of success, and only those with a return of at least ``demos.min_return``, if that is set.

    With ``relabel`` the actuations are those that the task's expert would give in the same states, and it drives every
    other copy itself (DAgger, Ross et al. 2011): a map learns where its policies go. Kept is every episode, then.

    Raises:
        FileNotFoundError: if ``run`` holds no finished run.
        ValueError: if it is of another task than ``env``, or a task without an expert is to be relabelled.
    """
    if run is None:
        raise ValueError("source=policy needs source.path: the folder of a finished run.")
    folder = Path(run)
    trained = read_config(folder, allow)
    if trained.env.name != env.name:
        raise ValueError(f"{run} is a run of env {trained.env.name!r}, expected {env.name!r}, as env says.")
    expert = make_expert(env.name) if relabel else None
    options = trained.env.options | endings(env.name)
    task_config = replace(trained.env, options=options, num_threads=env.num_threads)
    map = kept_map(folder, trained, allow=allow)
    simulation = mapped_env(task_config, map, seed=seed, num_envs=COPIES)
    policy, task = load_policy(folder, simulation, trained), simulation.base_env.task
    driver: Controller = policy
    if expert is not None:
        keys = map.context_keys if map.context_keys is not None else task_context_keys(env)
        driver = shared_driving(expert, policy, map, keys if map.context_dim else [], task)
    with closing(simulation), set_exploration_type(ExplorationType.DETERMINISTIC):
        data, left_out = record_episodes(
            simulation.base_env if relabel else simulation,
            task,
            driver,
            demos,
            judged=has_success(env.name) and not relabel,
            actuation_key=EXPERT_ACTION if relabel else ("next", "actuation"),
        )
    settings = {
        "options": options,
        "run": str(run),
        "min_return": demos.min_return,
        "left_out_episodes": left_out,
    }
    name = "raw policy" if trained.map.kind == "none" else f"{trained.map.kind} policy"
    if expert is not None:
        name = f"{type(expert).__name__} beside a {name}"
    return nht.save_demos(data, path, env=env.name, seed=seed, expert=name, settings=settings)


def import_demos(
    source: SourceConfig, env: EnvConfig, min_return: float | None, path: str | Path
) -> nht.Demos:
    """Save the whole episodes of a foreign file as demonstrations of ``env``; with ``min_return``, those that reach it.

    Raises:
        FileNotFoundError: if there is no such file.
        KeyError: for a key that the file lacks; the message lists those that are there.
        ValueError: if the file cannot be read, its values are not finite, or it does not fit the task.
    """
    data, left_out, found, expert, notes = read_episodes(source)
    expected = source.env or env.name
    if found != "unknown" and _bare(found) != _bare(expected):
        raise ValueError(
            f"{source.path} holds demonstrations of env {found!r}, expected {expected!r}: set env or env.name, or "
            "source.env if the task has another name there."
        )
    if min_return is not None:
        data, worse = best_episodes(data, min_return)
        left_out += worse
    settings = {"source": asdict(source), "min_return": min_return, "left_out_episodes": left_out, **notes}
    with naming(source.path):
        demos = nht.Demos.from_episodes(data, env=env.name, expert=expert, settings=settings)
    check_fits(demos, env, source.path or "")
    return nht.save_demos(demos.data, path, env=env.name, seed=None, expert=expert, settings=settings)


def check_fits(demos: nht.Demos, env: EnvConfig, name: str) -> None:
    """Check that demonstrations have the task's context keys, and as many motors and context entries as it has.

    Raises:
        KeyError: for a context key that they lack.
        ValueError: for another width.
    """
    found = {key: demos.context([key]).shape[-1] for key in task_context_keys(env)}
    if known_task(env) is None:
        return
    task = make_env(env.name, seed=0, **env.options)
    task.close()
    specs = {"actuation": task.action_spec, **task.observation_spec}
    for key, width in {"actuation": demos.actuation.shape[-1], **found}.items():
        if key in specs and width != specs[key].shape[-1]:
            raise ValueError(
                f"{name} does not fit {env.name}: {key!r} has {width} entries, the task's {specs[key].shape[-1]}."
            )


def _bare(env: str) -> str:
    """A task's name without namespace and version, in snake case: ``HalfCheetah-v5`` is ``half_cheetah``."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"-v\d+$", "", env.rsplit("/", 1)[-1]).lower())


if __name__ == "__main__":
    launch(main, CollectDemos, "collect_demos")
