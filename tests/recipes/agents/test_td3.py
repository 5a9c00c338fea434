"""TD3: its loss worked out by hand and against TorchRL's, and when the actor is updated."""

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP
from torchrl.objectives import SoftUpdate, TD3Loss, ValueEstimators

import tiny_runs
from nht.envs import make_env
from nht.recipes.agents.off_policy import JointSoftUpdate
from nht.recipes.agents.td3 import DirectTD3Loss, TD3Config, networks

GAMMA = 0.9


class Half(nn.Module):
    """The actor of the sums below: half of its one feature."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(0.5))

    def forward(self, features):
        return self.weight * features


def loss(biases=(0.0, 1.0), noise=0.0, reward_range=(-math.inf, math.inf)):
    """Critics Q_i = features + action + biases[i]; ``noise`` is what is drawn, before its deviation of 0.2."""
    actor = TensorDictModule(Half(), in_keys=["features"], out_keys=["action"])
    critic = MLP(2, 1, num_cells=[], activation_class=nn.ReLU)
    module = DirectTD3Loss(
        actor,
        TensorDictModule(critic, in_keys=["features", "action"], out_keys=["state_action_value"]),
        gamma=GAMMA,
        reward_range=reward_range,
        draw=lambda like: torch.full_like(like, noise),
    )
    for weights in (module.qvalue_network_params, module.target_qvalue_network_params):
        weights["module", "0", "weight"].data.fill_(1.0)
        weights["module", "0", "bias"].data.copy_(torch.tensor(biases).unsqueeze(-1))
    return module


def batch(features, action, next_features, reward, terminated=False, steps=1):
    flag = torch.tensor([[terminated]])
    column = {key: torch.tensor([[value]]) for key, value in [("features", features), ("action", action)]}
    outcome = {"features": torch.tensor([[next_features]]), "reward": torch.tensor([[reward]])}
    outcome |= {"done": flag, "terminated": flag.clone()}
    return TensorDict({**column, "steps_to_next_obs": torch.tensor([steps]), "next": outcome}, batch_size=[1])


def target(module, sample):
    return module.value_loss(sample)[1]["target_value"].item()


def test_target_takes_the_smaller_of_both_values():
    # next action = 0.5 * -2 = -1, next values = -3 and -2, target = -1 + 0.9 * -3 = -3.7; values = 1.5 and 2.5
    value_loss, found = loss().value_loss(batch(1.0, 0.5, -2.0, -1.0))
    assert found["target_value"].item() == pytest.approx(-3.7)
    assert value_loss.item() == pytest.approx((1.5 + 3.7) ** 2 + (2.5 + 3.7) ** 2)
    assert target(loss(biases=(1.0, 0.0)), batch(1.0, 0.5, -2.0, -1.0)) == pytest.approx(-3.7)


@pytest.mark.parametrize(
    ("noise", "action"),
    [
        (1.0, -0.8 + 0.2),  # a deviation of 0.2
        (10.0, -0.8 + 0.5),  # clipped
        (-10.0, -1.0),  # actions stay in [-1, 1]
    ],
)
def test_noise_smooths_the_targets_action(noise, action):
    found = target(loss(noise=noise), batch(1.0, 0.5, -1.6, 0.0))
    assert found == pytest.approx(GAMMA * (-1.6 + action))


def test_termination_stops_the_bootstrap_and_truncation_does_not():
    assert target(loss(), batch(1.0, 0.5, -2.0, -1.0, terminated=True)) == -1.0
    truncated = batch(1.0, 0.5, -2.0, -1.0)
    truncated["next", "done"] = torch.ones(1, 1, dtype=torch.bool)
    assert target(loss(), truncated) == pytest.approx(-3.7)


def test_targets_that_look_ahead_discount_as_often():
    assert target(loss(), batch(1.0, 0.5, -2.0, -1.0, steps=3)) == pytest.approx(-1.0 + GAMMA**3 * -3.0)


def test_targets_stay_within_the_returns_that_are_possible():
    limited = {"reward_range": (-1.0, 0.0)}
    assert target(loss(biases=(100.0, 100.0), **limited), batch(1.0, 0.5, 1.0, -1.0)) == 0.0
    assert target(loss(biases=(-100.0, 0.0), **limited), batch(1.0, 0.5, 1.0, -1.0)) == pytest.approx(-10.0)


def test_the_actor_follows_the_first_critic_and_leaves_both_alone():
    module = loss(biases=(0.0, -100.0))
    value, _ = module.actor_loss(batch(2.0, 0.0, 0.0, -1.0))
    assert value.item() == pytest.approx(-3.0)  # action = 1, value = 2 + 1
    value.backward()
    gradients = {name: parameter.grad for name, parameter in module.named_parameters()}
    assert all((gradient is not None) == ("actor" in name) for name, gradient in gradients.items())


def test_loss_and_learning_equal_those_of_torchrl():
    env = make_env("half_cheetah")
    _, actor, critic = networks(env, TD3Config(hidden=[32, 16]))
    ours = DirectTD3Loss(actor, critic, gamma=GAMMA)
    theirs = TD3Loss(deepcopy(actor), deepcopy(critic), bounds=(-1.0, 1.0), loss_function="l2")
    theirs.load_state_dict(ours.state_dict())
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    updaters = [JointSoftUpdate(ours, eps=0.75), SoftUpdate(theirs, eps=0.75)]
    optimisers = [torch.optim.SGD(module.parameters(), lr=0.1) for module in (ours, theirs)]
    for step in range(3):
        flags = torch.rand(2, 64, 1) < 0.3
        outcome = {"features": torch.randn(64, 17), "reward": torch.randn(64, 1)}
        outcome |= {"terminated": flags[0], "done": flags.any(0)}
        columns = {"features": torch.randn(64, 17), "action": torch.rand(64, 6) - 0.5}
        sample = TensorDict(
            {**columns, "steps_to_next_obs": torch.randint(1, 5, (64,)), "next": outcome}, [64]
        )
        for module, optimiser, updater in zip((ours, theirs), optimisers, updaters, strict=True):
            torch.manual_seed(step)  # of the noise
            losses = module(sample.clone())
            module.losses = {key: losses[key].detach() for key in ("loss_actor", "loss_qvalue")}
            (losses["loss_actor"] + losses["loss_qvalue"]).backward()
            optimiser.step()
            optimiser.zero_grad()
            updater.step()
        torch.testing.assert_close(ours.losses, theirs.losses)
        weights, expected = ours.state_dict(), theirs.state_dict()  # those of the target networks, too
        torch.testing.assert_close(dict(weights), {key: expected[key] for key in weights})


def test_actor_and_targets_wait_for_the_critics(tmp_path, monkeypatch):
    steps, seen = [], []

    def forward(self, sample, *, actor=True):
        before = steps.count("move")
        losses = plain(self, sample, actor=actor)
        seen.append((before, actor, losses["loss_actor"].item()))
        return losses

    plain, move = DirectTD3Loss.forward, JointSoftUpdate.step
    monkeypatch.setattr(DirectTD3Loss, "forward", forward)
    monkeypatch.setattr(JointSoftUpdate, "step", lambda self: (steps.append("move"), move(self)))
    overrides = ("algo.policy_delay=3", "algo.total_frames=400", "evaluation.every=400")
    metrics = tiny_runs.train("td3", tmp_path / "run", *overrides)
    assert metrics["updates"].tolist() == [12]
    assert [actor for _, actor, _ in seen] == [False, False, True] * 4
    assert [moves for moves, _, _ in seen] == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    own = [value for _, actor, value in seen if actor]
    assert metrics["loss_actor"].item() == pytest.approx(sum(own) / len(own), rel=1e-5)
