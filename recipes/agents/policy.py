"""Saves and loads the policy of a finished run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase

from nht.allowance import Allowance, FarLargerError
from nht.reading import plain_file, shortened
from nht.recipes.agents.policy_file import read_policy, write_policy
from nht.recipes.agents.table import find_algorithm, name_of
from nht.recipes.sections import Training

POLICY_FILE = "policy.safetensors"


def save_policy(state: Mapping[str, Tensor], folder: Path) -> None:
    """Write the state of the deterministic policy, its normaliser included."""
    write_policy(state, folder / POLICY_FILE)


def load_policy(folder: Path, env: EnvBase, config: Training) -> TensorDictModule:
    """The policy of a finished run, for an environment like the run's.

    Args:
        folder: of the run.
        env: whose observations it reads.
        config: of the run.

    Raises:
        FileNotFoundError: if the run has not finished.
        ValueError: if the file is damaged or was changed, if the policy does not fit the environment, or if the
            configuration describes networks far larger than the file holds: these are not built.
    """
    file = folder / POLICY_FILE
    size = plain_file(file).stat().st_size
    try:
        with Allowance(size, "a policy"):
            policy = find_algorithm(name_of(type(config))).policy(env, config.algo)
    except FarLargerError:
        raise ValueError(
            f"{folder / 'config.yaml'} describes a policy far larger than the {size:,} bytes of {POLICY_FILE}."
        ) from None
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / 'config.yaml'} describes no policy: {shortened(error)}.") from error
    policy.load_state_dict(read_policy(file, policy.state_dict()))
    return policy
