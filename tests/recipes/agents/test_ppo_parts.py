"""PPO's parts: its loss against TorchRL's, advantages worked out by hand, normalisers and weights."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from nht.envs import make_env
from nht.recipes.agents.norm import ReturnNorm
from nht.recipes.agents.ppo import (
    GaussianActor,
    GaussianPPOLoss,
    PPOConfig,
    estimate_advantages,
    networks,
)

GAMMA, LAMBDA = 0.9, 0.8

# The loss is TorchRL's, faster.


def minibatch(size: int = 64) -> TensorDict:
    column = (size, 1)
    entries = {"features": torch.randn(size, 5), "sample": torch.randn(size, 3)}
    entries |= {"sample_log_prob": -4.0 + 0.3 * torch.randn(size), "advantage": 2.0 + torch.randn(column)}
    return TensorDict(
        entries | {"value_target": torch.randn(column), "state_value": torch.randn(column)}, [size]
    )


def small_networks() -> tuple[GaussianActor, nn.Module]:
    mean = nn.Sequential(nn.Linear(5, 8), nn.Tanh(), nn.Linear(8, 3))
    return GaussianActor(mean, 3, initial_std=0.7), nn.Sequential(nn.Linear(5, 8), nn.Tanh(), nn.Linear(8, 1))


@pytest.mark.parametrize("clip_value", [False, True])
@pytest.mark.parametrize("entropy_coeff", [0.0, 0.01])
def test_loss_and_gradients_equal_those_of_torchrl(clip_value, entropy_coeff):
    actor, critic = small_networks()
    value = TensorDictModule(critic, ["features"], ["state_value"])
    ours = GaussianPPOLoss(
        TensorDictModule(actor, ["features"], ["sample", "sample_log_prob", "action"]),
        value,
        clip=0.2,
        clip_value=clip_value,
        critic_coeff=0.5,
        entropy_coeff=entropy_coeff,
    )

    class Parameters(nn.Module):
        def forward(self, features):
            mean = actor.network(features)
            return mean, actor.log_std.exp().expand_as(mean)

    theirs = ClipPPOLoss(
        ProbabilisticTensorDictSequential(
            TensorDictModule(Parameters(), ["features"], ["loc", "scale"]),
            ProbabilisticTensorDictModule(
                ["loc", "scale"], ["sample"], distribution_class=IndependentNormal, return_log_prob=True
            ),
        ),
        value,
        clip_epsilon=0.2,
        clip_value=clip_value,
        critic_coeff=0.5,
        entropy_coeff=entropy_coeff,
        normalize_advantage=True,
        loss_critic_type="l2",
        functional=False,
    )
    batch = minibatch()
    found = ours(batch)
    expected = theirs(batch)
    for name in GaussianPPOLoss.reports:
        torch.testing.assert_close(
            found[name], expected[name].squeeze(), msg=lambda m, name=name: f"{name}: {m}"
        )
    parts = expected["loss_objective"] + expected["loss_critic"] + expected["loss_entropy"]
    torch.testing.assert_close(found["loss"], parts.squeeze())
    assert 0 < found["clip_fraction"] < 1
    parameters = [*actor.parameters(), *critic.parameters()]
    for mine, other in zip(
        torch.autograd.grad(found["loss"], parameters), torch.autograd.grad(parts, parameters), strict=True
    ):
        torch.testing.assert_close(mine, other)


def test_the_actor_is_a_gaussian_whose_actions_are_clipped():
    actor, _ = small_networks()
    features = torch.randn(100, 5)
    sample, log_prob, action = actor(features)
    normal = torch.distributions.Normal(actor.network(features), actor.log_std.exp())
    torch.testing.assert_close(log_prob, normal.log_prob(sample).sum(-1))
    assert sample.abs().max() > 1
    assert action.equal(sample.clamp(-1, 1))
    again, entropy = actor.log_prob(features, sample)
    torch.testing.assert_close(again, log_prob)
    torch.testing.assert_close(entropy.expand(100), normal.entropy().sum(-1))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert actor(features)[0].equal(actor.network(features))


# Time limits.


def value_is_the_observation() -> tuple[TensorDictModule, TensorDictModule, GAE]:
    features = TensorDictModule(nn.Identity(), ["observation"], ["features"])
    critic = TensorDictModule(nn.Identity(), ["features"], ["state_value"])
    return features, critic, GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=None)


def steps(observation, following, reward, terminated, truncated) -> TensorDict:
    values = {"observation": observation, "following": following, "reward": reward}
    observation, following, reward = (torch.tensor([row])[..., None] for row in values.values())
    terminated, truncated = (torch.tensor([row])[..., None] for row in (terminated, truncated))
    outcome = {"observation": following, "reward": reward}
    outcome |= {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return TensorDict({"observation": observation, "features": observation, "next": outcome}, [1, 4])


@pytest.mark.parametrize("terminates", [False, True])
def test_advantages_at_the_end_of_an_episode(terminates):
    # Two steps 1 -> 2 -> 5, an end, then a new episode from -3 that goes on: -3 -> 4 -> 6.
    ends = [False, True, False, False]
    never = [False] * 4
    data = steps(
        [1.0, 2.0, -3.0, 4.0],
        [2.0, 5.0, 4.0, 6.0],
        [0.5, 1.0, -1.0, 2.0],
        terminated=ends if terminates else never,
        truncated=never if terminates else ends,
    )
    estimate_advantages(data, *value_is_the_observation())
    bootstrap = 0.0 if terminates else GAMMA * 5.0  # of the state that the time limit cut off, not of -3
    last = 1.0 + bootstrap - 2.0
    first = 0.5 + GAMMA * 2.0 - 1.0 + GAMMA * LAMBDA * last
    fourth = 2.0 + GAMMA * 6.0 - 4.0
    third = -1.0 + GAMMA * 4.0 + 3.0 + GAMMA * LAMBDA * fourth
    advantage = data["advantage"].flatten()
    torch.testing.assert_close(advantage, torch.tensor([first, last, third, fourth]))
    torch.testing.assert_close(
        data["value_target"].flatten(), advantage + torch.tensor([1.0, 2.0, -3.0, 4.0])
    )


def test_what_is_collected_at_a_time_limit_is_the_episodes_own_last_observation():
    env = make_env("wam_wipe", 2, start="random", max_episode_steps=3, seed=0)
    features, actor, critic = networks(env, PPOConfig(hidden=[8]))
    policy = TensorDictSequential(features, actor)
    collector = Collector(
        env,
        policy,
        frames_per_batch=12,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    data = next(iter(collector))
    collector.shutdown()
    assert data["next", "truncated"][:, 2].all()
    assert not data["next", "terminated"].any()
    reached, started = data["next", "observation"][:, 2], data["observation"][:, 3]
    assert (reached - started).abs().max() > 0.1  # another start, drawn at random
    for step in (0, 1, 3, 4):
        assert data["next", "observation"][:, step].equal(data["observation"][:, step + 1])
    gae = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=None)
    estimate_advantages(data, features, critic, gae)
    with torch.no_grad():
        value = critic.module(features.module(reached))
    delta = data["next", "reward"][:, 2] + GAMMA * value - data["state_value"][:, 2]
    torch.testing.assert_close(data["advantage"][:, 2], delta)


# Normalisation.


def test_rewards_are_divided_by_the_deviation_of_all_discounted_returns():
    norm = ReturnNorm(2, GAMMA, clip=1.5)
    generator = torch.Generator().manual_seed(0)
    returns, current = [], torch.zeros(2, dtype=torch.float64)
    for _ in range(3):
        reward = 4.0 * torch.randn(2, 5, 1, generator=generator)
        done = torch.rand(2, 5, 1, generator=generator) < 0.3
        for step in range(5):
            current = GAMMA * current + reward[:, step, 0]
            returns.append(current.clone())
            current[done[:, step, 0]] = 0.0
        data = TensorDict({"next": {"reward": reward.clone(), "done": done}}, [2, 5])
        norm(data)
        deviation = torch.stack(returns).std(correction=0).float()
        torch.testing.assert_close(data["next", "reward"], (reward / deviation).clamp(-1.5, 1.5))
    assert data["next", "reward"].abs().max() == 1.5


def test_weights_start_orthogonal():
    env = make_env("wam_wipe", seed=0)
    _, actor, critic = networks(env, PPOConfig(hidden=[8, 8], activation="relu", initial_std=0.5))
    for network, last_gain in ((actor.module.network, 0.01), (critic.module, 1.0)):
        layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        for layer, gain in zip(layers, (math.sqrt(2), math.sqrt(2), last_gain), strict=True):
            rows = layer.weight @ layer.weight.T
            torch.testing.assert_close(rows, gain**2 * torch.eye(len(rows)), atol=1e-5, rtol=1e-4)
            assert not layer.bias.any()
    assert sum(isinstance(layer, nn.ReLU) for layer in critic.module) == 2
    torch.testing.assert_close(actor.module.log_std.exp(), torch.full((7,), 0.5))
