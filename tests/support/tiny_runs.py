"""Runs of the recipes that take a second: what they are told, and how to start one."""

import pandas

from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure

RECIPES = ("ddpg", "ppo", "sac", "td3")
SHARED = [
    "env=wam_wipe",
    "map=none",
    "env.num_envs=4",
    "env.options.max_episode_steps=25",
    "algo.frames_per_batch=100",
    "algo.hidden=[16,16]",
    "evaluation.episodes=3",
    "evaluation.video=false",
    "run.checkpoint_every=200",
    "run.wandb=false",
]
REPLAY = ["algo.updates_per_batch=3", "algo.warmup_frames=0", "algo.buffer_size=1000"]
OWN = {
    "ddpg": REPLAY,
    "ppo": ["algo.minibatches=5", "algo.epochs=2"],
    "sac": [*REPLAY, "algo.random_frames=200"],
    "td3": [*REPLAY, "algo.random_frames=200"],
}


def settings(algorithm, folder, *overrides):
    return [*SHARED, *OWN[algorithm], f"run.folder={folder}", *overrides]


def start(algorithm, folder, *overrides):
    """Train a run, or go on with it, to its end."""
    found = find_algorithm(algorithm)
    found.train(configure(found.schema, algorithm, settings(algorithm, folder, *overrides)))


def train(algorithm, folder, *overrides):
    """Train, and give the metrics without what differs from time to time."""
    start(algorithm, folder, *overrides)
    return pandas.read_csv(folder / "metrics.csv").drop(columns="seconds")
