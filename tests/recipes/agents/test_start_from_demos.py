"""An actor that starts from demonstrations: it comes to do what they show, alone and among others."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from nht.envs import make_env
from nht.recipes.agents import ddpg, ppo, sac, td3
from nht.recipes.agents.settings import Setting
from nht.recipes.agents.stacking import of_learner, stacked
from nht.recipes.agents.start_from_demos import start_from_demos
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import AlgoDemosConfig

COUNT = 300
ALGORITHMS = {
    "ddpg": partial(ddpg.networks, algo=ddpg.DDPGConfig(hidden=[32])),
    "ppo": partial(ppo.networks, algo=ppo.PPOConfig(hidden=[32])),
    "sac": partial(sac.networks, algo=sac.SACConfig(hidden=[32])),
    "td3": partial(td3.networks, algo=td3.TD3Config(hidden=[32])),
}


def made(algorithm: str, seed: int) -> tuple[Any, Any]:
    """Normaliser and actor of hopper."""
    torch.manual_seed(seed)
    features, actor, _ = ALGORITHMS[algorithm](make_env("hopper", 1, seed=0))
    return features, actor


def shown(seed: int) -> Any:
    """Steps whose action is a function of what is seen."""
    generator = torch.Generator().manual_seed(seed)
    observation = 5.0 + 3.0 * torch.randn(1, COUNT, 11, generator=generator)
    return TensorDict(
        {"observation": observation, "action": (0.3 * (observation[..., :3] - 5.0)).tanh()}, [1, COUNT]
    )


def start(
    features: Any, actor: Any, steps: Any, updates: int, seeds: Sequence[int] = (0,), rate: Setting = 3e-3
) -> None:
    demos = AlgoDemosConfig(transitions=COUNT, cloning_start=updates)
    configs: Any = [SimpleNamespace(seed=seed, algo=SimpleNamespace(demos=demos)) for seed in seeds]
    start_from_demos(steps, features, actor, configs, rate, Ranks())


@torch.no_grad()
def missed(features: Any, actor: Any, steps: Any) -> float:
    """The mean squared distance of the actor's actions, without exploration, from those that were demonstrated."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = actor(features(steps[0].select("observation")))
    return float((seen["action"] - steps[0]["action"]).square().mean())


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_actor_comes_to_do_what_was_demonstrated(algorithm: str) -> None:
    features, actor = made(algorithm, 0)
    steps = shown(0)
    start(features, actor, steps, updates=0)
    before = missed(features, actor, steps)
    torch.testing.assert_close(features.module.mean, steps["observation"][0].double().mean(0))
    start(features, actor, steps, updates=300)
    assert missed(features, actor, steps) < 0.05 * before


@pytest.mark.parametrize("algorithm", ["ddpg", "ppo"])
def test_each_of_several_learners_starts_as_it_would_alone(algorithm: str) -> None:
    alone = [made(algorithm, seed) for seed in (3, 4)]
    together = [stacked(kind) for kind in zip(*(made(algorithm, seed) for seed in (3, 4)), strict=True)]
    start(*together, torch.stack([shown(3), shown(4)]), 20, (3, 4), torch.tensor([1e-3, 3e-3]))
    for place, (features, actor) in enumerate(alone):
        start(features, actor, shown(3 + place), 20, (3 + place,), (1e-3, 3e-3)[place])
        for network, of_all in ((features, together[0]), (actor, together[1])):
            for name, value in of_learner(of_all.state_dict(), place).items():
                torch.testing.assert_close(value, network.state_dict()[name], rtol=1e-4, atol=1e-6)


def test_its_draws_are_its_own() -> None:
    weights = []
    for seed in (0, 0, 1):
        features, actor = made("ddpg", 0)
        torch.manual_seed(7)
        start(features, actor, shown(0), 20, (seed,))
        weights.append(next(actor.parameters()).detach().clone())
        torch.manual_seed(7), (expected := torch.rand(3))
        torch.manual_seed(7)
        start(features, actor, shown(0), 1, (seed,))
        assert torch.rand(3).equal(expected)
    assert weights[0].equal(weights[1])
    assert not weights[0].equal(weights[2])


def test_without_demonstrations_or_steps_nothing_happens() -> None:
    features, actor = made("ddpg", 0)
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    start(features, actor, None, 20)
    assert int(features.module.count) == 0
    start(features, actor, shown(0), 0)
    assert int(features.module.count) == COUNT
    assert all(value.equal(before[name]) for name, value in actor.state_dict().items())


# Bad input.


def test_a_start_without_demonstrations() -> None:
    with pytest.raises(
        ValueError, match=r"algo.demos.cloning_start=5 imitates .*: set algo.demos.transitions, too."
    ):
        AlgoDemosConfig(cloning_start=5)


def test_fewer_than_no_steps() -> None:
    with pytest.raises(ValueError, match=r"algo.demos.cloning_start must be at least 0, got -1."):
        AlgoDemosConfig(transitions=5, cloning_start=-1)
