"""Demonstrations from a task's scripted expert.

python -m nht.recipes.collect_demos env=wam_wipe demos.transitions=20000 out=runs/demos
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

import nht
from nht.envs import BatchedMujocoEnv, Expert, make_env, make_expert
from nht.recipes.config import CollectDemos, DemosConfig, EnvConfig
from nht.recipes.launch import launch

COPIES = 100


def main(config: CollectDemos) -> None:
    """Collect, save and say what came out."""
    demos = collect_demos(config.env, config.demos, config.seed, config.out)
    lengths = demos.episode.bincount()
    print(
        f"{len(demos):,} transitions in {len(lengths):,} successful episodes of {float(lengths.float().mean()):.0f} "
        f"steps on average\nsaved in {config.out}"
    )


def collect_demos(env: EnvConfig, demos: DemosConfig, seed: int, path: str | Path) -> nht.Demos:
    """Run the expert until ``demos.transitions`` transitions of successful episodes are there, and save them.

    Episodes end at success. Those that fail or run out of time are left out, and counted in the manifest.

    Raises:
        FileExistsError: if ``path`` exists.
        ValueError: if the task has no expert, or its options are unknown.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path} exists: demonstrations are never overwritten. Choose another folder.")
    ending = {
        "terminate_on_success": True,
        "terminate_on_failure": True,
        "max_episode_steps": demos.max_episode_steps,
    }
    options = env.options | ending
    simulation = make_env(env.name, COPIES, env.num_threads, seed=seed, **options)
    settings = {} if demos.speed is None else {"speed": demos.speed}
    expert = make_expert(env.name, **settings)
    try:
        data, unsuccessful = _record(simulation, expert, demos.transitions)
    finally:
        simulation.close()
    manifest = {"options": options, "expert": settings, "left_out_episodes": unsuccessful}
    name = type(expert).__name__
    return nht.save_demos(data, path, env=env.name, seed=seed, expert=name, settings=manifest)


def _record(simulation: BatchedMujocoEnv, expert: Expert, transitions: int) -> tuple[TensorDict, int]:
    """Whole successful episodes, one after the other, and how many others were seen."""
    current = simulation.reset()
    steps: list[TensorDictBase] = []
    length, collected = torch.zeros(COPIES, dtype=torch.int64), 0
    patience = 10 * simulation.task.max_episode_steps
    with tqdm(total=transitions, desc="demonstrations", unit="step", unit_scale=True) as progress:
        while collected < transitions:
            observation = {key: current[key].numpy() for key in simulation.task.observation_sizes}
            current["action"] = torch.from_numpy(expert(observation)).float()
            stepped, current = simulation.step_and_maybe_reset(current)
            steps.append(stepped)
            length += 1
            done, success = (stepped["next", flag].view(-1) for flag in ("done", "success"))
            collected += int(length[done & success].sum())
            length[done] = 0
            progress.update(min(collected, transitions) - progress.n)
            if not collected and len(steps) >= patience:
                raise RuntimeError(f"the expert had no success in {len(steps) * COPIES:,} steps.")
    return _successful_episodes(torch.stack(steps, dim=1), list(simulation.task.observation_sizes))


def _successful_episodes(steps: TensorDictBase, keys: list[str]) -> tuple[TensorDict, int]:
    """From ``(N, T)`` steps, the transitions of the episodes that ended in success, and the number that did not."""
    done, success = (steps["next", flag].squeeze(-1) for flag in ("done", "success"))
    nth = done.cumsum(dim=1) - done.long()  # of the copy's episodes
    episode = nth + nth.amax() * torch.arange(len(nth))[:, None] + torch.arange(len(nth))[:, None]
    kept = torch.isin(episode, episode[done & success])
    flat, outcome = steps[kept], steps["next"][kept]
    flags = ("reward", "success", "terminated", "truncated", "done")
    data = {
        **{key: flat[key] for key in keys},
        "actuation": flat["action"],
        "episode": episode[kept].unique_consecutive(return_inverse=True)[1],
        **{flag: outcome[flag] for flag in flags},
        "next": {key: outcome[key] for key in keys},
    }
    return TensorDict(data, batch_size=flat.batch_size), int((done & ~success).sum())


if __name__ == "__main__":
    launch(main, CollectDemos, "collect_demos")
