"""Small populations: runs whose learners differ, beside what each of them would be alone."""

import contextlib

import pandas
import torch

import nht
import tiny_runs
from nht.recipes import ddpg, ppo
from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure
from nht.recipes.run.record import Record

MAINS = {"ddpg": ddpg.main, "ppo": ppo.main}
OWN = {
    "ddpg": {
        "a": ["seed=3", "algo.batch_size=32"],
        "b": [
            "seed=8",
            "algo.batch_size=20",
            "algo.gamma=0.9",
            "algo.polyak=0.5",
            "algo.pessimism=0.3",
            "algo.actor_learning_rate=0.003",
            "algo.critic_learning_rate=0.0005",
            "algo.action_l2=0.5",
            "algo.exploration_noise=0.1",
            "algo.noise_memory=1",
            "algo.random_action=0.5",
        ],
        "c": ["seed=5", "algo.batch_size=47", "algo.gamma=0.8", "algo.actor_learning_rate=0.01"],
    },
    "ppo": {
        "a": ["seed=3"],
        "b": [
            "seed=8",
            "algo.initial_std=0.5",
            "algo.learning_rate=0.001",
            "algo.gamma=0.9",
            "algo.lmbda=0.5",
            "algo.clip=0.3",
            "algo.critic_coeff=1.5",
            "algo.entropy_coeff=0.02",
            "algo.max_grad_norm=0.05",
        ],
        "c": ["seed=5", "algo.gamma=0.8", "algo.initial_std=0.3"],
    },
}
"""What learners have of their own: all that may differ does."""
SHORT = ["algo.total_frames=200", "evaluation.every=100", "run.checkpoint_every=100"]


def map_of(folder, seed, hidden=(8,)):
    """A file with a map of seven motors that WAMWipe can be driven through."""
    map = nht.NHT(10, 7, 2, hidden=hidden, start="random", seed=seed)
    drawn = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in map.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=drawn)
    map.context_keys = ("tool_position", "joint_angle")
    folder.mkdir(parents=True, exist_ok=True)
    return nht.save_map(map, folder / f"map-{seed}.safetensors")


def config(algorithm, folder, *overrides):
    schema = find_algorithm(algorithm).schema
    return configure(schema, algorithm, tiny_runs.settings(algorithm, folder, *SHORT, *overrides))


def train(algorithm, folder, learners):
    """Train learners together, each told by its overrides under its name; the metrics of each."""
    configs = [config(algorithm, folder / name, *overrides) for name, overrides in learners.items()]
    MAINS[algorithm](*configs, together=str(folder))
    return {name: metrics(folder / name) for name in learners}


def metrics(folder):
    return pandas.read_csv(folder / "metrics.csv").drop(columns="seconds")


@contextlib.contextmanager
def watched(patch):
    """What every update reported, ``(updates, L)`` or ``(updates,)`` by name: filled at the end."""
    seen, found = [], {}
    count = Record.count_update

    def watch(self, losses):
        means = {name: value for name, value in losses.items() if name != "target_value"}
        seen.append({name: value.detach().clone() for name, value in means.items()})
        count(self, losses)

    with patch.context() as patched:
        patched.setattr(Record, "count_update", watch)
        yield found
    found |= {name: torch.stack([each[name] for each in seen]) for name in seen[0]}


@contextlib.contextmanager
def breaking_off(patch, frames):
    """Within, a run breaks off when it has made so many steps."""
    count = Record.count_steps

    def stop(self, data):
        count(self, data)
        if self.frames == frames:
            raise KeyboardInterrupt

    with patch.context() as patched:
        patched.setattr(Record, "count_steps", stop)
        yield


class Lost(nht.ActionMap):
    """Gives no numbers."""

    def forward(self, action, context):
        return action.new_full((*action.shape[:-1], self.actuation_dim), torch.nan)

    def project(self, actuation, context):
        return actuation[..., : self.action_dim]
