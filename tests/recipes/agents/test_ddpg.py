"""What the recipes add to TorchRL's DDPG, against values worked out by hand."""

import math
from copy import deepcopy

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from nht.envs import make_env
from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss, networks
from nht.recipes.agents.norm import RunningNorm
from nht.recipes.agents.off_policy import JointSoftUpdate
from nht.recipes.agents.returns import charge_failure, n_step_returns, return_range, reward_range

GAMMA = 0.9


class Linear(nn.Module):
    """Sum of all inputs times a weight, plus a bias."""

    def __init__(self, weight: float, bias: float) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.tensor(weight)), nn.Parameter(torch.tensor(bias))

    def forward(self, *inputs):
        return self.weight * torch.cat(inputs, -1).sum(-1, keepdim=True) + self.bias


def loss(critic_bias=0.0, action_l2=0.0, reward_range=(-1.0, 0.0)):
    actor = TensorDictModule(Linear(0.5, 0.0), in_keys=["features"], out_keys=["action"])
    critic = TensorDictModule(
        Linear(1.0, critic_bias), in_keys=["features", "action"], out_keys=["state_action_value"]
    )
    return PaperDDPGLoss(actor, critic, gamma=GAMMA, action_l2=action_l2, reward_range=reward_range)


def batch(features, action, next_features, reward, terminated=False):
    flag = torch.tensor([[terminated]])
    column = {key: torch.tensor([[value]]) for key, value in [("features", features), ("action", action)]}
    outcome = {"features": torch.tensor([[next_features]]), "reward": torch.tensor([[reward]])}
    outcome |= {"done": flag, "terminated": flag.clone()}
    steps = {"steps_to_next_obs": torch.ones(1, dtype=torch.long)}
    return TensorDict({**column, **steps, "next": outcome}, batch_size=[1])


def test_target_is_reward_plus_discounted_target_value():
    # next action = 0.5 * -2 = -1, next value = -2 - 1 = -3, target = -1 + 0.9 * -3 = -3.7; value = 1 + 0.5 = 1.5
    losses = loss()(batch(1.0, 0.5, -2.0, -1.0))
    assert losses["target_value"].item() == pytest.approx(-3.7)
    assert losses["loss_value"].item() == pytest.approx((1.5 + 3.7) ** 2)


def test_termination_stops_the_bootstrap_and_truncation_does_not():
    assert loss()(batch(1.0, 0.5, -2.0, -1.0, terminated=True))["target_value"].item() == -1.0
    truncated = batch(1.0, 0.5, -2.0, -1.0)
    truncated["next", "done"] = torch.ones(1, 1, dtype=torch.bool)
    assert loss()(truncated)["target_value"].item() == pytest.approx(-3.7)


def test_targets_stay_within_the_returns_that_are_possible():
    assert loss(critic_bias=100.0)(batch(1.0, 0.5, 1.0, -1.0))["target_value"].item() == 0.0
    assert loss(critic_bias=-100.0)(batch(1.0, 0.5, 1.0, -1.0))["target_value"].item() == pytest.approx(-10.0)


def test_targets_are_free_where_rewards_know_no_bound():
    # next action = 0.5, next value = 1 + 0.5 + 100
    module = loss(critic_bias=100.0, reward_range=(-math.inf, math.inf))
    assert module(batch(1.0, 0.5, 1.0, 2.0))["target_value"].item() == pytest.approx(2.0 + GAMMA * 101.5)


def test_actor_pays_for_large_actions_and_leaves_the_critic_alone():
    # action = 0.5 * 2 = 1, value = 2 + 1 = 3
    module = loss(action_l2=0.25)
    value, _ = module.loss_actor(batch(2.0, 0.0, 0.0, -1.0))
    assert value.item() == pytest.approx(0.25 - 3.0)
    value.backward()
    gradients = {name: parameter.grad for name, parameter in module.named_parameters()}
    assert all((gradient is not None) == ("actor" in name) for name, gradient in gradients.items())


def test_ddpg_loss_is_torchrls():
    torch.manual_seed(0)
    env = make_env("half_cheetah", seed=0)
    _, actor, critic = networks(env, DDPGConfig(hidden=[32, 16]))
    settings = {"delay_actor": True, "delay_value": True}
    ours = PaperDDPGLoss(actor, critic, gamma=GAMMA, action_l2=0.0, reward_range=(-math.inf, math.inf))
    theirs = DDPGLoss(deepcopy(actor), deepcopy(critic), **settings)
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    updaters = [JointSoftUpdate(ours, eps=0.75), SoftUpdate(theirs, eps=0.75)]
    optimisers = [torch.optim.SGD(module.parameters(), lr=0.1) for module in (ours, theirs)]
    for _ in range(3):
        flags = torch.rand(2, 64, 1) < 0.3
        outcome = {"features": torch.randn(64, 17), "reward": torch.randn(64, 1)}
        outcome |= {"terminated": flags[0], "done": flags.any(0)}
        columns = {"features": torch.randn(64, 17), "action": torch.rand(64, 6) - 0.5}
        sample = TensorDict(
            {**columns, "steps_to_next_obs": torch.randint(1, 5, (64,)), "next": outcome}, [64]
        )
        losses = [module(sample.clone()) for module in (ours, theirs)]
        for key in ("loss_actor", "loss_value", "target_value"):
            torch.testing.assert_close(losses[0][key], losses[1][key])
        for loss, optimiser, updater in zip(losses, optimisers, updaters, strict=True):
            (loss["loss_actor"] + loss["loss_value"]).backward()
            optimiser.step()
            optimiser.zero_grad()
            updater.step()
        weights, expected = ours.state_dict(), theirs.state_dict()  # those of the target networks, too
        torch.testing.assert_close(dict(weights), {key: expected[key] for key in weights})


def test_failure_that_ends_an_episode_costs_minus_one_for_ever():
    flags = torch.tensor([[True, True], [True, False], [False, True], [False, False]])
    steps = TensorDict(
        {
            "next": {
                "reward": -torch.ones(4, 1),
                "failure": flags[:, :1],
                "terminated": flags[:, 1:],
            }
        },
        batch_size=[4],
    )
    charged = charge_failure(steps, GAMMA, (-1.0, 0.0))["next", "reward"].squeeze(-1)
    assert return_range((-1.0, 0.0), GAMMA) == pytest.approx((-10.0, 0.0))
    assert return_range((-1.0, 0.0), GAMMA, steps=2) == pytest.approx((-1.9, 0.0))
    assert return_range((-1.0, 2.0), 1.0, steps=200) == (-200.0, 400.0)
    assert charged.tolist() == pytest.approx([-10.0, -1.0, -1.0, -1.0])


def test_targets_look_ahead_to_the_end_of_an_episode_and_no_further():
    # Two copies, five steps of reward -1. The first fails in its third step, the second runs into its time limit.
    terminated, truncated = torch.zeros(2, 2, 5, 1, dtype=torch.bool)
    terminated[0, 2] = truncated[1, 2] = True
    time = torch.arange(5.0).expand(2, 5).unsqueeze(-1)
    outcome = {"features": time + 1.0, "reward": -torch.ones(2, 5, 1), "failure": terminated.clone()}
    outcome |= {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    collected = TensorDict({"features": time, "action": torch.zeros(2, 5, 1), "next": outcome}, [2, 5])

    ahead = n_step_returns(GAMMA, 2)(charge_failure(collected, GAMMA, (-1.0, 0.0)))

    assert ahead["steps_to_next_obs"].tolist() == [[2, 2, 1, 2, 1]] * 2  # a batch is an end, too
    assert ahead["next", "features"].squeeze(-1).tolist() == [[2.0, 3.0, 3.0, 5.0, 5.0]] * 2
    assert ahead["next", "terminated"].squeeze(-1).tolist() == [
        [False, True, True, False, False],
        [False] * 5,
    ]
    # the next action is half the features, and the critic's value their sum
    targets = [
        loss(reward_range=(-math.inf, math.inf))(ahead[:, i])["target_value"].tolist() for i in range(5)
    ]
    value = {features: 1.5 * features for features in (2.0, 3.0, 5.0)}
    expected = [
        [-1.9 + 0.81 * value[2.0], -1.9 + 0.81 * value[2.0]],
        [-1.0 - 0.9 * 10.0, -1.9 + 0.81 * value[3.0]],
        [-10.0, -1.0 + 0.9 * value[3.0]],
        [-1.9 + 0.81 * value[5.0], -1.9 + 0.81 * value[5.0]],
        [-1.0 + 0.9 * value[5.0], -1.0 + 0.9 * value[5.0]],
    ]
    torch.testing.assert_close(torch.tensor(targets), torch.tensor(expected))


def test_running_norm_equals_the_mean_and_deviation_of_all_it_saw():
    generator = torch.Generator().manual_seed(0)
    rows = 3.0 + 2.0 * torch.randn(500, 4, generator=generator, dtype=torch.float64)
    norm = RunningNorm(4)
    for part in rows.split([1, 99, 150, 250]):
        norm.update(part)
    torch.testing.assert_close(norm.shift, rows.mean(0).float())
    torch.testing.assert_close(norm.scale, rows.std(0, correction=0).float())
    assert norm(torch.full((2, 4), 1e6)).max() == 5.0


def test_running_norm_does_not_divide_by_a_vanishing_deviation():
    norm = RunningNorm(1)
    norm.update(torch.full((10, 1), 2.0))
    torch.testing.assert_close(norm(torch.tensor([[2.005]])), torch.tensor([[0.5]]), atol=1e-4, rtol=0)


@given(value=st.floats(-10.0, 10.0, width=32), rows=st.integers(1, 500), batches=st.integers(1, 3))
def test_running_norm_takes_what_never_changes(value, rows, batches):
    norm = RunningNorm(1)
    for _ in range(batches):
        norm.update(torch.full((rows, 1), value))
    assert norm.scale == norm.floor
    assert norm(torch.full((1, 1), value)).abs() < 1e-3


@pytest.mark.parametrize(
    ("rewards", "returns"),
    [
        ((-1.0, 0.0), (-10.0, 0.0)),
        ((0.0, 1.0), (0.0, 10.0)),
        ((0.5, 1.0), (0.0, 10.0)),  # an episode may end at once
        ((-math.inf, math.inf), (-math.inf, math.inf)),
    ],
)
def test_the_returns_that_rewards_can_add_up_to(rewards, returns):
    assert return_range(rewards, GAMMA) == pytest.approx(returns)


def test_failure_costs_nothing_more_where_rewards_know_no_bound():
    flag = torch.ones(1, 1, dtype=torch.bool)
    steps = TensorDict(
        {"next": {"reward": torch.full((1, 1), 3.0), "failure": flag, "terminated": flag}}, [1]
    )
    assert charge_failure(steps.clone(), GAMMA, (-math.inf, math.inf))["next", "reward"] == 3.0
    assert charge_failure(steps.clone(), GAMMA, (0.0, 1.0))["next", "reward"] == 0.0


@pytest.mark.parametrize(
    ("task", "rewards"),
    [("wam_wipe", (-1.0, 0.0)), ("wam_grasp", (-1.0, 0.0)), ("half_cheetah", (-math.inf, math.inf))],
)
def test_the_range_of_rewards_is_read_from_the_task(task, rewards):
    assert reward_range(make_env(task, seed=0)) == rewards
