"""Whole PPO iterations, ours beside others': 2,048 steps, 10 epochs of 32 minibatches of 64, networks of 2 x 64 tanh.

Contestants, one process, one torch thread, in turn within each round:

- ``nht``: `nht.recipes.ppo` itself, run for two lengths; the difference is divided by the iterations between them.
- ``plain``: the same arithmetic in plain PyTorch on the same batched task: a floor, without normalisers or statistics.
- ``sb3-16`` and ``sb3-1``: stable-baselines3's PPO with its VecNormalize on 16 and on 1 Gymnasium environments.
- ``torchrl``: the settings of TorchRL's own PPO recipe: SerialEnv of GymEnv, VecNorm, GAE anew in each epoch, a replay
  buffer, eager losses.

CPU seconds count, as other programs may share the cores. Prints the table and writes ``results/ppo_speed``.

    OMP_NUM_THREADS=1 python benchmarks/speed/ppo_speed.py [half_cheetah | wam_wipe] [rounds]
"""

from __future__ import annotations

import csv
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, RewardSum, SerialEnv, TransformedEnv, VecNormV2
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import nht.envs
from nht.recipes.agents.ppo import orthogonal
from nht.recipes.config import PPO
from nht.recipes.launch import configure
from nht.recipes.ppo import main

GYMNASIUM = {"half_cheetah": "HalfCheetah-v5", "wam_wipe": "nht/WAMWipe-v0"}
STEPS, EPOCHS, MINIBATCHES, COPIES, HIDDEN = 2_048, 10, 32, 16, [64, 64]
SHORT, LONG = 2, 10  # iterations of the recipe
GAMMA, LAMBDA, CLIP, RATE, MAX_NORM = 0.99, 0.95, 0.2, 3e-4, 0.5
Iteration = Callable[[], object]


def recipe_seconds(task: str) -> tuple[float, float]:
    """CPU and wall seconds of one iteration of the recipe."""

    def run(iterations: int) -> None:
        frames = iterations * STEPS
        with tempfile.TemporaryDirectory() as folder:
            overrides = [f"env={task}", "map=none", f"run.folder={folder}/run", f"env.num_envs={COPIES}"]
            overrides += ["algo=ppo_paper", "algo.clip_value=false", f"algo.total_frames={frames}"]
            overrides += [f"evaluation.every={frames}", "evaluation.episodes=1", "evaluation.video=false"]
            overrides += ["run.wandb=false", f"run.checkpoint_every={1000 * STEPS}"]
            main(configure(PPO, "ppo", overrides))

    short, long = (timed(lambda n=n: run(n), times=1) for n in (SHORT, LONG))
    return tuple((b - a) / (LONG - SHORT) for a, b in zip(short, long, strict=True))


def plain(task_name: str) -> Iteration:
    """Collection, GAE and updates without any library above PyTorch."""
    task = nht.envs.make_task(task_name, num_envs=COPIES, seed=0)
    size, actions = task.observation_sizes["observation"], task.actuation_bounds[0].size
    actor, critic = orthogonal(network(size, actions), 0.01), orthogonal(network(size, 1), 1.0)
    log_std = nn.Parameter(torch.zeros(actions))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimiser = torch.optim.Adam(parameters, lr=RATE, eps=1e-5, fused=True)
    constant = 0.5 * actions * math.log(2 * math.pi)

    def density(deviates: Tensor) -> Tensor:
        return -0.5 * deviates.square().sum(-1) - log_std.sum() - constant

    def observe() -> Tensor:
        return torch.from_numpy(task.observe()["observation"].astype(np.float32))

    @torch.no_grad()
    def collect() -> tuple[Tensor, ...]:
        rows: list[tuple[Tensor, ...]] = []
        observation = observe()
        for _ in range(STEPS // COPIES):
            deviates = torch.randn(COPIES, actions)
            sample = actor(observation) + deviates * log_std.exp()
            outcome = task.step(sample.clamp(-1, 1).double().numpy())
            following = observe()
            done = outcome.terminated | outcome.truncated
            flags = (outcome.reward.astype(np.float32), outcome.terminated, done)
            rows.append(
                (observation, sample, density(deviates), following, *(torch.from_numpy(x) for x in flags))
            )
            if done.any():
                task.reset(np.flatnonzero(done))
            observation = observe() if done.any() else following
        return tuple(torch.stack(column) for column in zip(*rows, strict=True))

    @torch.no_grad()
    def estimate(observation: Tensor, following: Tensor, *signals: Tensor) -> tuple[Tensor, Tensor]:
        reward, terminated, done = signals
        value, later = critic(observation).squeeze(-1), critic(following).squeeze(-1)
        delta = reward + GAMMA * later * ~terminated - value
        advantage, current = torch.empty_like(delta), torch.zeros(COPIES)
        for step in reversed(range(len(delta))):
            current = delta[step] + GAMMA * LAMBDA * ~done[step] * current
            advantage[step] = current
        return advantage, advantage + value

    def update(batch: tuple[Tensor, ...]) -> None:
        observation, sample, old, advantage, target = batch
        ratio = (density((sample - actor(observation)) * (-log_std).exp()) - old).exp()
        advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        objective = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
        loss = 0.25 * (critic(observation).squeeze(-1) - target).square().mean() - objective
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, MAX_NORM)
        optimiser.step()
        optimiser.zero_grad()

    def iterate() -> None:
        observation, sample, old, following, *signals = collect()
        advantage, target = estimate(observation, following, *signals)
        steps = [x.flatten(0, 1) for x in (observation, sample, old, advantage, target)]
        for _ in range(EPOCHS):
            order = torch.randperm(STEPS)
            for batch in zip(*(x[order].split(STEPS // MINIBATCHES) for x in steps), strict=True):
                update(batch)

    task.reset()
    return iterate


def network(size: int, out: int) -> MLP:
    return MLP(size, out, num_cells=HIDDEN, activation_class=nn.Tanh)


def stable_baselines(task: str, copies: int) -> Iteration:
    """stable-baselines3 with the same settings."""
    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make(GYMNASIUM[task])] * copies), gamma=GAMMA)
    model = stable_baselines3.PPO(
        "MlpPolicy",
        env,
        learning_rate=RATE,
        n_steps=STEPS // copies,
        batch_size=STEPS // MINIBATCHES,
        n_epochs=EPOCHS,
        policy_kwargs={"net_arch": HIDDEN},
        device="cpu",
        seed=0,
    )
    return lambda: model.learn(STEPS, reset_num_timesteps=False)


def torchrl(task: str) -> Iteration:
    """TorchRL's parts in the arrangement of its own recipe for MuJoCo."""

    def make() -> EnvBase:
        return GymEnv(GYMNASIUM[task], categorical_action_encoding=False)

    env = TransformedEnv(SerialEnv(1, make), DoubleToFloat())
    env.append_transform(VecNormV2(in_keys=["observation"]))
    env.append_transform(RewardSum())
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    mean = nn.Sequential(network(size, actions), AddStateIndependentNormalScale(actions))
    policy = ProbabilisticActor(
        TensorDictModule(mean, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec_unbatched,
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(network(size, 1), in_keys=["observation"])
    gae = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=critic)
    loss = ClipPPOLoss(
        policy,
        critic,
        clip_epsilon=CLIP,
        loss_critic_type="l2",
        entropy_coeff=0.0,
        critic_coeff=0.25,
        normalize_advantage=True,
    )
    optimiser = torch.optim.Adam(loss.parameters(), lr=RATE, eps=1e-5)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(STEPS), sampler=SamplerWithoutReplacement(), batch_size=STEPS // MINIBATCHES
    )
    collector = Collector(env, policy, frames_per_batch=STEPS, total_frames=-1)
    batches = iter(collector)

    def iterate() -> None:
        data = next(batches)
        for _ in range(EPOCHS):
            with torch.no_grad():
                data = gae(data)
            buffer.extend(data.reshape(-1))
            for batch in buffer:
                losses = loss(batch)
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), MAX_NORM)
                optimiser.step()
                optimiser.zero_grad()

    return iterate


def timed(call: Iteration, times: int) -> tuple[float, float]:
    """CPU and wall seconds of one call, on average."""
    cpu, wall = time.process_time(), time.perf_counter()
    for _ in range(times):
        call()
    return (time.process_time() - cpu) / times, (time.perf_counter() - wall) / times


def benchmark(task: str, rounds: int) -> None:
    """All contestants in turn, round after round."""
    torch.set_num_threads(1)
    contestants = {
        "plain": plain(task),
        "sb3-16": stable_baselines(task, 16),
        "sb3-1": stable_baselines(task, 1),
        "torchrl": torchrl(task),
    }
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in ("nht", *contestants)}
    for _ in range(rounds + 1):  # the first one warms up
        measured["nht"].append(recipe_seconds(task))
        for name, iterate in contestants.items():
            measured[name].append(timed(iterate, times=1))
    report("ppo_speed", task, STEPS, {name: values[1:] for name, values in measured.items()})


def report(name: str, task: str, steps: int, measured: dict[str, list[tuple[float, float]]]) -> None:
    """Print and save environment steps per CPU second and per second, and CPU time over ours.

    Args:
        name: of the CSV file.
        task: that was stepped.
        steps: environment steps behind every measured time.
        measured: CPU and wall seconds by contestant and round; ours are called ``nht``.
    """
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout
    with (Path(__file__).parents[1] / "results" / name / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        columns = ["contestant", "task", "round", "cpu_seconds", "wall_seconds", "commit", "cores", "torch"]
        writer.writerow(columns)
        for contestant, values in measured.items():
            for number, (cpu, wall) in enumerate(values):
                machine = [commit.strip(), os.cpu_count(), torch.__version__]
                writer.writerow([contestant, task, number, f"{cpu:.4f}", f"{wall:.4f}", *machine])
            ratios = [cpu / ours for (cpu, _), (ours, _) in zip(values, measured["nht"], strict=True)]
            rates = [steps / statistics.median(seconds) for seconds in zip(*values, strict=True)]
            print(
                f"{contestant:>8}  {rates[0]:7.0f} steps per CPU second  {rates[1]:7.0f} per second  "
                f"{statistics.median(ratios):5.2f} x our CPU time ({min(ratios):.2f} .. {max(ratios):.2f})"
            )
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}")


if __name__ == "__main__":
    benchmark(sys.argv[1] if len(sys.argv) > 1 else "half_cheetah", int((sys.argv + ["5"] * 2)[2]))
