"""A finished run's policy, which may drive, and its critic's view of what is done."""

from __future__ import annotations

import copy
import importlib
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from nht.reading import shortened
from nht.recipes.agents.policy import load_policy
from nht.recipes.agents.table import find_algorithm, name_of
from nht.recipes.live.interfaces import Interface
from nht.recipes.run.checkpoint_file import CheckpointFile
from nht.recipes.sections import Training

CRITICS = ("value_network_params.", "qvalue_network_params.", "critic_network.")
"""How the losses of DDPG, of TD3 and SAC, and of PPO begin the names of their critics' weights."""


class Pilot:
    """The policy of a finished run.

    Args:
        folder: of the run.
        config: of the run.
        interface: the task through the run's map, which the policy acts through.

    Raises:
        FileNotFoundError: if the run has not finished.
        ValueError: if its policy cannot be read, or does not fit the task.

    Attributes:
        interface: as given.
        critic: its critic's view; None if there is none.
        no_critic: why there is none, as a sentence.
    """

    def __init__(self, folder: Path, config: Training, interface: Interface) -> None:
        self.interface = interface
        self._policy = load_policy(folder, interface.env, config)
        self.critic: Critic | None = None
        self.no_critic = ""
        try:
            self.critic = Critic(folder, config, interface)
        except (FileNotFoundError, ValueError, RuntimeError, AttributeError) as error:
            self.no_critic = f"No critic: {shortened(error).removesuffix('.')}."

    @torch.no_grad()
    def action(self, observed: TensorDictBase) -> Tensor:
        """What the policy does, without exploration, ``(1, k)``."""
        seen = TensorDict({"observation": observed["observation"]}, batch_size=[1])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            found: Tensor = self._policy(seen)["action"]
        return found


class Critic:
    """The critic of a run, from its last checkpoint.

    Args:
        folder: of the run.
        config: of the run.
        interface: the task through the run's map.

    Raises:
        FileNotFoundError: if the run kept no checkpoint.
        ValueError: if the last one has no critic of a known algorithm.

    Attributes:
        judges_actions: whether it values what is done, or only the state.
    """

    def __init__(self, folder: Path, config: Training, interface: Interface) -> None:
        files = sorted((folder / "checkpoints").glob("checkpoint-*.torchrl"))
        if not files:
            raise FileNotFoundError(f"{folder} keeps no checkpoint.")
        with CheckpointFile(files[-1]) as file:
            states = file.read()
        record = find_algorithm(name_of(type(config)))
        networks = importlib.import_module(record.policy.__module__).networks
        self._norm, _, critic = networks(interface.env, config.algo)
        self._norm.load_state_dict(states["features"])
        self._critics = [_loaded(critic, weights) for weights in _weights(states["loss"], files[-1])]
        self.judges_actions = "action" in critic.in_keys

    @torch.no_grad()
    def value(self, observed: TensorDictBase, action: Tensor) -> float:
        """The return that the run's critic expects from here, the least of several critics.

        Args:
            observed: raw observations, ``(1,)``.
            action: through the run's own interface, ``(1, k)``.
        """
        seen = TensorDict({"observation": observed["observation"], "action": action}, batch_size=[1])
        seen = self._norm(seen)
        out = self._critics[0].out_keys[0]
        return min(float(critic(seen.clone(recurse=False))[out]) for critic in self._critics)


def _weights(loss: dict[str, Any], file: Path) -> list[dict[str, Tensor]]:
    """The weights of each critic in the state of a loss; those of two critics are stacked."""
    for start in CRITICS:
        found = {name.removeprefix(start): value for name, value in loss.items() if name.startswith(start)}
        found = {name: value for name, value in found.items() if isinstance(value, Tensor)}
        if not found:
            continue
        if start != "qvalue_network_params.":
            return [found]
        return [{name: value[i] for name, value in found.items()} for i in range(2)]
    raise ValueError(f"{file} has no critic of a known algorithm.")


def _loaded(critic: TensorDictModule, weights: dict[str, Tensor]) -> TensorDictModule:
    own = copy.deepcopy(critic)
    own.load_state_dict(weights)
    return own
