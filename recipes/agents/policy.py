"""The policy of a finished run: written, and read again."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import load_file, save_file
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import EnvBase

from nht.recipes.agents.table import find_algorithm, name_of
from nht.recipes.sections import Training

POLICY_FILE = "policy.safetensors"


def save_policy(policy: nn.Module, folder: Path) -> None:
    """Write the deterministic policy, its normaliser included."""
    save_file(policy.state_dict(), folder / POLICY_FILE)


def load_policy(folder: Path, env: EnvBase, config: Training) -> TensorDictModule:
    """The policy of a finished run, for an environment like the run's.

    Args:
        folder: of the run.
        env: whose observations it reads.
        config: that the run was started with.

    Raises:
        FileNotFoundError: if the run has not finished.
        RuntimeError: if the policy does not fit the environment.
    """
    policy = find_algorithm(name_of(type(config))).policy(env, config.algo)
    policy.load_state_dict(load_file(folder / POLICY_FILE))
    return policy
