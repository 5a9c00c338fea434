"""The whole loop of DDPG, ours beside stable-baselines3's: one update per step, batch 256, networks of 2 x 256.

Contestants, one process, one torch thread, in turn within each round:

- ``nht``: `nht.recipes.ddpg` itself, run for two lengths; the difference is divided by the steps between them.
- ``nht-bf16``: the same with ``algo.bfloat16=true``.
- ``sb3-10`` and ``sb3-1``: stable-baselines3's DDPG on 10 (as many as ours) and on 1 Gymnasium environments.

CPU seconds count, as other programs may share the cores. Prints the table and writes ``results/ddpg_speed``.

    OMP_NUM_THREADS=1 python benchmarks/speed/ddpg_speed.py [half_cheetah | wam_wipe] [rounds]
"""

from __future__ import annotations

import sys
import tempfile

import gymnasium
import numpy as np
import stable_baselines3
import torch
from ppo_speed import GYMNASIUM, Iteration, report, timed
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from nht.recipes.config import DDPG
from nht.recipes.ddpg import main
from nht.recipes.launch import configure

STEPS, COPIES, HIDDEN, BATCH = 1_000, 10, [256, 256], 256
SHORT, LONG = 500, 1_500  # steps of the recipe


def recipe_seconds(task: str, bfloat16: bool = False) -> tuple[float, float]:
    """CPU and wall seconds of ``STEPS`` steps of the recipe."""

    def run(frames: int) -> None:
        with tempfile.TemporaryDirectory() as folder:
            settings = [f"env={task}", "map=none", "algo=ddpg_locomotion", f"run.folder={folder}/run"]
            settings += [f"algo.hidden={HIDDEN}", f"algo.batch_size={BATCH}", "algo.warmup_frames=0"]
            settings += ["algo.random_frames=0", f"algo.bfloat16={bfloat16}"]
            settings += ["algo.buffer_size=100000", f"algo.total_frames={frames}", f"env.num_envs={COPIES}"]
            settings += [f"evaluation.every={frames}", "evaluation.episodes=1", "evaluation.video=false"]
            settings += ["run.wandb=false", "run.checkpoint_every=10000000"]
            main(configure(DDPG, "ddpg", settings))

    short, long = (timed(lambda n=n: run(n), times=1) for n in (SHORT, LONG))
    return tuple((b - a) * STEPS / (LONG - SHORT) for a, b in zip(short, long, strict=True))


def stable_baselines(task: str, copies: int) -> Iteration:
    """stable-baselines3 with the same settings."""
    env = DummyVecEnv([lambda: gymnasium.make(GYMNASIUM[task])] * copies)
    actions = env.action_space.shape[-1]
    model = stable_baselines3.DDPG(
        "MlpPolicy",
        env,
        learning_rate=1e-3,
        buffer_size=100_000,
        learning_starts=0,
        batch_size=BATCH,
        train_freq=1,
        gradient_steps=-1,  # as many as environments were stepped
        action_noise=NormalActionNoise(np.zeros(actions), 0.1 * np.ones(actions)),
        policy_kwargs={"net_arch": HIDDEN},
        device="cpu",
        seed=0,
    )
    return lambda: model.learn(STEPS, reset_num_timesteps=False)


def benchmark(task: str, rounds: int) -> None:
    """All contestants in turn, round after round."""
    torch.set_num_threads(1)
    others = {f"sb3-{copies}": stable_baselines(task, copies) for copies in (COPIES, 1)}
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in ("nht", "nht-bf16", *others)}
    for _ in range(rounds + 1):  # the first one warms up
        measured["nht"].append(recipe_seconds(task))
        measured["nht-bf16"].append(recipe_seconds(task, bfloat16=True))
        for name, iterate in others.items():
            measured[name].append(timed(iterate, times=1))
    report("ddpg_speed", task, STEPS, {name: values[1:] for name, values in measured.items()})


if __name__ == "__main__":
    benchmark(sys.argv[1] if len(sys.argv) > 1 else "half_cheetah", int((sys.argv + ["5"] * 2)[2]))
