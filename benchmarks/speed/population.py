"""What a learner costs alone and in a population: core-seconds per learner and 1,000,000 environment steps.

The whole recipes run, physics, replay and evaluations included, in one process with one torch thread, each in a process
of its own. Settings:

- ``search``: DDPG of the search on WAMWipe through NHT: networks of 2 x 128, 40 updates per 400 steps, learning rates,
  noise, batch sizes and so on drawn from the paper's Table 2; 25 test episodes every 20,000 steps. As packs of a
  search, learners are of nearly one batch size, here around its mean.
- ``paper``: the paper's own DDPG: 3 x 256, 40 updates of 256 per 200 steps.
- ``ppo``: OpenAI's ppo2 on HalfCheetah: 2 x 64, 32 x 10 minibatches of 64 per 2,048 steps, 16 copies a learner.

Beside them stable-baselines3, one learner with the same networks, batch and ratio on the same task. Every figure is the
difference of two lengths of the run, so that starting does not count; an evaluation is measured apart. Rounds take
turns; the median counts, the spread is printed. Writes CSV, table and figure to ``results/population``.

    OMP_NUM_THREADS=1 python benchmarks/speed/population.py [search | paper | ppo ...] [rounds=3]
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import stable_baselines3
import torch
from omegaconf import OmegaConf
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from taking_turns import provenance

import nht
from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure
from nht.recipes.study.space import draw_settings

HERE = Path(__file__).parents[1]
OUT = HERE / "results" / "population"
SPACE = OmegaConf.to_container(OmegaConf.load(HERE.parent / "configs" / "search" / "wam.yaml"))["space"]
EVERY, EVALUATIONS = 20_000, 50  # steps between evaluations, evaluations in 1,000,000 steps
QUIET = ["evaluation.video=false", "run.wandb=false", "run.checkpoint_every=${algo.total_frames}"]

SETTINGS: dict[str, list[str]] = {
    "search": [
        "env=wam_wipe",
        "env.num_envs=40",
        "algo.hidden=[128,128]",
        "algo.frames_per_batch=400",
        "algo.updates_per_batch=40",
        "algo.warmup_frames=0",
        "evaluation.episodes=25",
    ],
    "paper": ["env=wam_wipe", "algo=ddpg_paper", "evaluation.episodes=25"],
    "ppo": ["env=half_cheetah", "map=none", "algo=ppo_paper", "env.num_envs=16", "evaluation.episodes=10"],
}
LENGTHS = {"search": (400, 2_000), "paper": (200, 800), "ppo": (2_048, 4_096)}  # steps
COLUMNS = ("setting", "who", "learners", "bfloat16", "round", "core_seconds", "evaluations", "memory")
MEAN_BATCH = 144  # of Table 2
PLAN = {
    "search": [(count, half) for half in (False, True) for count in (1, 4, 16, 64)],
    "paper": [(1, False), (1, True), (4, True), (16, True)],
    "ppo": [(1, False), (4, False), (16, False), (64, False)],
}


def drawn(learner: int, learners: int) -> dict[str, object]:
    """A draw from Table 2 for one learner of a pack, which has the draws with batch sizes nearest to the mean."""
    many = [draw_settings(SPACE, 0, number, "nht") for number in range(8 * learners)]
    many.sort(key=lambda one: abs(one["algo.batch_size"] - MEAN_BATCH))
    return {name: value for name, value in many[learner].items() if name.startswith("algo.")}


def overrides(setting: str, learner: int, learners: int, folder: Path) -> list[str]:
    """The overrides of one learner."""
    told = [*SETTINGS[setting], *QUIET, f"seed={learner}", f"run.folder={folder}/{learner}"]
    if setting == "ppo":
        return told
    told.append(f"map.file={folder}/map.safetensors")
    if setting == "search":
        told += [f"{name}={value}" for name, value in drawn(learner, learners).items()]
    return told


def train(setting: str, learners: int, half: bool, steps: int, every: int) -> float:
    """Processor seconds of a run."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        map = nht.NHT(10, 7, 2, hidden=(64, 64)).eval()
        map.context_keys = ("tool_position", "joint_angle")
        nht.save_map(map, folder / "map.safetensors")
        algorithm = find_algorithm("ppo" if setting == "ppo" else "ddpg")
        more = [f"algo.total_frames={steps}", f"evaluation.every={every}"]
        more += [f"algo.bfloat16={half}"] if setting != "ppo" else []
        configs = [
            configure(
                algorithm.schema,
                "ppo" if setting == "ppo" else "ddpg",
                [*overrides(setting, learner, learners, folder), *more],
            )
            for learner in range(learners)
        ]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            began = time.process_time()
            algorithm.train(*configs, together=str(folder / "together") if learners > 1 else None)
            return time.process_time() - began


def cost(setting: str, learners: int, half: bool) -> dict[str, float]:
    """Core-seconds per learner and 1,000,000 steps, and the largest memory [MB]."""
    short, long = LENGTHS[setting]
    train(setting, learners, half, short, short)  # warm-up
    before, after = (train(setting, learners, half, steps, steps) for steps in (short, long))
    often = train(setting, learners, half, long, short)
    a_test = (often - after) / (long / short - 1)
    stepping = (after - before) / (long - short)
    million = (stepping * 1e6 + a_test * EVALUATIONS) / learners
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"core_seconds": million, "evaluations": a_test * EVALUATIONS / learners, "memory": memory}


def baseline(setting: str, copies: int) -> dict[str, float]:
    """stable-baselines3's core-seconds per 1,000,000 steps, without evaluations."""
    if setting == "ppo":
        env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("HalfCheetah-v5")] * copies), gamma=0.99)
        steps, hidden = 2_048, {"net_arch": [64, 64]}
        model = stable_baselines3.PPO(
            "MlpPolicy",
            env,
            n_steps=steps // copies,
            batch_size=64,
            policy_kwargs=hidden,
            device="cpu",
            seed=0,
        )
    else:
        make = partial(gymnasium.make, "nht.envs:nht/WAMWipe-v0")
        env, motors = DummyVecEnv([make] * copies), 7
        per_update = 10 if setting == "search" else 5
        steps = {"search": 2_000, "paper": 500}[setting]
        model = stable_baselines3.DDPG(
            "MlpPolicy",
            env,
            learning_starts=0,
            buffer_size=100_000,
            batch_size=MEAN_BATCH if setting == "search" else 256,
            train_freq=max(1, per_update // copies),
            gradient_steps=max(1, copies // per_update),
            action_noise=NormalActionNoise(np.zeros(motors), 0.1 * np.ones(motors)),
            policy_kwargs={"net_arch": [128, 128] if setting == "search" else [256, 256, 256]},
            device="cpu",
            seed=0,
        )
    model.learn(steps, reset_num_timesteps=False)
    began = time.process_time()
    model.learn(steps, reset_num_timesteps=False)
    return {"core_seconds": (time.process_time() - began) / steps * 1e6, "evaluations": 0.0, "memory": 0.0}


def apart(*words: object) -> dict[str, float]:
    """A measurement in a process of its own."""
    command = [sys.executable, __file__, "measure", *map(str, words)]
    found = subprocess.run(command, capture_output=True, text=True)
    if found.returncode:
        raise RuntimeError(found.stderr)
    return json.loads(found.stdout.strip().splitlines()[-1])


def benchmark(chosen: list[str], rounds: int) -> None:
    """All measurements in turn, round after round."""
    plan: list[tuple[str, str, int, bool]] = []
    for setting in chosen:
        plan += [(setting, "nht", learners, half) for learners, half in PLAN[setting]]
        plan += [
            (setting, "stable-baselines3", copies, False) for copies in (1, 10 if setting != "ppo" else 16)
        ]
    OUT.mkdir(parents=True, exist_ok=True)
    file = OUT / "rounds.csv"
    fresh = not file.exists()
    with file.open("a", newline="") as handle:
        writer = csv.writer(handle)
        if fresh:
            writer.writerow(
                ("setting", "who", "learners", "bfloat16", "round", "core_seconds", "evaluations", "memory")
            )
        for number in range(rounds):
            for setting, who, learners, half in plan:
                found = apart(who, setting, learners, half)
                writer.writerow(
                    (setting, who, learners, half, number, *(round(v, 2) for v in found.values()))
                )
                handle.flush()
                print(setting, who, learners, half, {k: round(v, 1) for k, v in found.items()}, flush=True)
    show(file)
    (OUT / "provenance.json").write_text(json.dumps(provenance(rounds), indent=1))


def show(file: Path) -> None:
    """Medians and spreads."""
    with file.open() as handle:
        rows = list(csv.DictReader(handle))
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault((row["setting"], row["who"], row["learners"], row["bfloat16"]), []).append(row)
    print(
        "| setting | who | learners | bfloat16 | core-seconds per learner and 1M steps | of them evaluations | memory |"
    )
    print("|---|---|---|---|---|---|---|")
    for key, found in groups.items():
        costs = [float(row["core_seconds"]) for row in found]
        tests, memory = (
            statistics.median(float(row[name]) for row in found) for name in ("evaluations", "memory")
        )
        spread = f"{statistics.median(costs):.0f} ({min(costs):.0f} .. {max(costs):.0f})"
        print("| " + " | ".join([*key, spread, f"{tests:.0f}", f"{memory:.0f} MB"]) + " |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    words = sys.argv[1:]
    if words[:1] == ["measure"]:
        _, who, setting, learners, half = words
        measured = (
            cost(setting, int(learners), half == "True") if who == "nht" else baseline(setting, int(learners))
        )
        print(json.dumps(measured))
    else:
        given = [int(word.partition("=")[2]) for word in words if word.startswith("rounds=")]
        benchmark([word for word in words if word in PLAN] or list(PLAN), given[0] if given else 3)
