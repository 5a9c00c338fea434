"""Whole episodes of a task, recorded as demonstrations: from its scripted expert, or from any controller."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import EnvBase

import nht
from nht.envs import make_env, make_expert
from nht.envs.registry import TASKS, find_task
from nht.envs.task import BatchedTask
from nht.recipes.data.answers import EXPERT_ACTION, Controller, Disturbance, answering
from nht.recipes.progress_bar import progress_bar
from nht.recipes.sections import DemosConfig, EnvConfig

COPIES = 100
RECORDED = ("reward", "success", "terminated", "truncated", "done")


def record_expert(env: EnvConfig, demos: DemosConfig, seed: int, path: str | Path) -> nht.Demos:
    """Run the expert until there are ``demos.transitions`` transitions of good episodes, and save them.

    Episodes end at success. Those that fail or run out of time are left out, and counted in the manifest.

    With ``demos.disturbance`` noise moves the motors off the expert's way, and its answer to that is recorded, not what
    was done (DART, Laskey et al. 2017): a map sees contexts beside the way.

    Raises:
        FileExistsError: if ``path`` exists.
        ValueError: if the task has no expert, or its options are unknown.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path} exists: demonstrations are never overwritten. Choose another folder.")
    settings = {} if demos.speed is None else {"speed": demos.speed}
    expert = make_expert(env.name, **settings)
    options = env.options | endings(env.name) | {"max_episode_steps": demos.max_episode_steps}
    simulation = make_env(env.name, COPIES, env.num_threads, seed=seed, **options)

    answer = answering(expert, simulation.task)
    disturb = Disturbance(demos.disturbance, seed) if demos.disturbance else None

    def act(current: TensorDictBase) -> TensorDictBase:
        current = answer(current)
        wanted = current[EXPERT_ACTION]
        return current.set("action", wanted if disturb is None else disturb(wanted))

    with closing(simulation):
        data, left_out = record_episodes(
            simulation,
            simulation.task,
            act,
            demos,
            judged=has_success(env.name),
            actuation_key="action" if disturb is None else EXPERT_ACTION,
        )
    settings = settings | ({"disturbance": demos.disturbance} if demos.disturbance else {})
    manifest = {"options": options, "expert": settings, "left_out_episodes": left_out}
    name = type(expert).__name__
    return nht.save_demos(data, path, env=env.name, seed=seed, expert=name, settings=manifest)


def endings(task: str) -> dict[str, bool]:
    """The options that make a task's episodes end at success and at failure, as far as it has them."""
    return find_task(task).endings if task in TASKS else {}


def has_success(task: str) -> bool:
    """Whether a task has a notion of success, that is, an option to end episodes there."""
    return task in TASKS and find_task(task).has_success


@torch.no_grad()
def record_episodes(
    simulation: EnvBase,
    task: BatchedTask,
    act: Controller,
    demos: DemosConfig,
    *,
    judged: bool,
    actuation_key: NestedKey = "action",
) -> tuple[TensorDict, int]:
    """Run ``act`` until there are ``demos.transitions`` transitions of good episodes.

    Args:
        simulation: copies of a task, transformed or not.
        task: what it simulates.
        act: chooses the actions.
        demos: how many transitions, and the return that a good episode must have.
        judged: whether a good episode must end in success.
        actuation_key: key of the executed actuation in the data of a step. With ``EXPERT_ACTION``, which was not
            executed, the rewards and next observations, which are not its, are left out.

    Returns:
        the good episodes, one after the other, and how many others ended.

    Raises:
        RuntimeError: if there is no good episode in ten times the longest duration of one.
    """
    least = -math.inf if demos.min_return is None else demos.min_return
    current = simulation.reset()
    steps: list[TensorDict] = []
    length = torch.zeros(simulation.batch_size, dtype=torch.int64)
    total, collected = torch.zeros(simulation.batch_size, dtype=torch.float64), 0
    with progress_bar(demos.transitions, "demonstrations", "step", unit_scale=True) as progress:
        while collected < demos.transitions:
            stepped, current = simulation.step_and_maybe_reset(act(current))
            done, success = (stepped["next", flag].view(-1) for flag in ("done", "success"))
            length += 1
            total += stepped["next", "reward"].view(-1)
            good = done & (total >= least) & (success | (not judged))
            steps.append(_transition(stepped, list(task.observation_sizes), actuation_key, good))
            collected += int(length[good].sum())
            length[done], total[done] = 0, 0.0
            progress.update(min(collected, demos.transitions) - progress.n)
            if not collected and len(steps) >= 10 * task.max_episode_steps:
                wanted = ["a success"] * judged + [f"a return of at least {least}"] * math.isfinite(least)
                raise RuntimeError(
                    f"no episode in {len(steps) * len(length):,} steps had {' and '.join(wanted) or 'an end'}."
                )
    return _good_episodes(torch.stack(steps, dim=1), demos.transitions)


def _transition(
    stepped: TensorDictBase, keys: list[str], actuation_key: NestedKey, good: torch.Tensor
) -> TensorDict:
    """The entries of a step that are kept, ``(N,)``, and whether it ended a good episode."""
    outcome = stepped["next"]
    entries = {
        **{key: stepped[key] for key in keys},
        "actuation": stepped[actuation_key],
        **{flag: outcome[flag] for flag in RECORDED},
        "next": {key: outcome[key] for key in keys},
        "good": good,
    }
    if actuation_key == EXPERT_ACTION:
        del entries["reward"], entries["next"]
    return TensorDict(entries, batch_size=stepped.batch_size)


def _good_episodes(steps: TensorDict, transitions: int) -> tuple[TensorDict, int]:
    """From ``(N, T)`` steps the transitions of the good episodes, and the number of others that ended.

    Episodes are taken in the order of their ends until there are ``transitions``: copies that started together may all
    end together.
    """
    done, good = steps["done"].squeeze(-1), steps["good"]
    nth = done.cumsum(dim=1) - done.long()  # of the copy's episodes
    episode = nth + (nth.amax() + 1) * torch.arange(len(nth))[:, None]
    first_to_end = episode.T[good.T]
    lengths = torch.bincount(episode.flatten())[first_to_end]
    enough = int((lengths.cumsum(0) < transitions).sum()) + 1
    kept = torch.isin(episode, first_to_end[:enough])
    data = steps[kept].exclude("good")
    data["episode"] = episode[kept].unique_consecutive(return_inverse=True)[1]
    return data, int((done & ~good).sum())
