"""SAC: its loss worked out by hand and against TorchRL's, its temperature and its policy."""

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from nht.envs import make_env
from nht.recipes.agents.off_policy import JointSoftUpdate
from nht.recipes.agents.sac import (
    LOG_STD,
    DirectSACLoss,
    GaussianHead,
    SACConfig,
    networks,
    tanh_gaussian,
)

GAMMA, TEMPERATURE, GOAL, STD = 0.9, 0.5, -1.0, math.exp(-1.0)


class Affine(nn.Module):
    """Half the one feature as the mean, a constant as the logarithm of the deviation."""

    def __init__(self, log_std):
        super().__init__()
        self.weight, self.log_std = nn.Parameter(torch.tensor(0.5)), nn.Parameter(torch.tensor(log_std))

    def forward(self, features):
        return torch.cat([self.weight * features, self.log_std.expand_as(features)], -1)


def loss(noise=1.0, log_std=-1.0, biases=(0.0, 1.0)):
    """Critics Q_i = features + action + biases[i]; ``noise`` is what is drawn."""
    critic = MLP(2, 1, num_cells=[], activation_class=nn.ReLU)
    module = DirectSACLoss(
        tanh_gaussian(GaussianHead(Affine(log_std))),
        TensorDictModule(critic, in_keys=["features", "action"], out_keys=["state_action_value"]),
        gamma=GAMMA,
        target_entropy=GOAL,
        initial_temperature=TEMPERATURE,
        draw=lambda like: torch.full_like(like, noise),
    )
    for weights in (module.qvalue_network_params, module.target_qvalue_network_params):
        weights["module", "0", "weight"].data.fill_(1.0)
        weights["module", "0", "bias"].data.copy_(torch.tensor(biases).unsqueeze(-1))
    return module


def batch(features, action, next_features, reward, terminated=False):
    flag = torch.tensor([[terminated]])
    column = {key: torch.tensor([[value]]) for key, value in [("features", features), ("action", action)]}
    outcome = {"features": torch.tensor([[next_features]]), "reward": torch.tensor([[reward]])}
    outcome |= {"done": flag, "terminated": flag.clone()}
    steps = torch.ones(1, dtype=torch.long)
    return TensorDict({**column, "steps_to_next_obs": steps, "next": outcome}, batch_size=[1])


def action_and_log_prob(mean, std=STD, noise=1.0):
    """Of a tanh-Gaussian, by the textbook: log N(u) - log (1 - tanh(u)^2)."""
    u = mean + std * noise
    density = -0.5 * noise**2 - math.log(std) - 0.5 * math.log(2.0 * math.pi)
    return math.tanh(u), density - math.log(1.0 - math.tanh(u) ** 2)


def test_target_is_the_smaller_value_with_its_entropy():
    action, log_prob = action_and_log_prob(mean=-1.0)
    expected = -1.0 + GAMMA * (-2.0 + action - TEMPERATURE * log_prob)
    value_loss, found = loss().qvalue_v2_loss(batch(1.0, 0.5, -2.0, -1.0))
    assert found["target_value"].item() == pytest.approx(expected, rel=1e-5)
    errors = (1.5 - expected, 2.5 - expected)
    assert value_loss.item() == pytest.approx(sum(error**2 for error in errors), rel=1e-5)


def test_termination_ends_the_entropy_too_and_truncation_nothing():
    (_, ended), (_, going_on) = (
        loss().qvalue_v2_loss(batch(1.0, 0.5, -2.0, -1.0, terminated=flag)) for flag in (True, False)
    )
    assert ended["target_value"].item() == -1.0
    truncated = batch(1.0, 0.5, -2.0, -1.0)
    truncated["next", "done"] = torch.ones(1, 1, dtype=torch.bool)
    assert loss().qvalue_v2_loss(truncated)[1]["target_value"].equal(going_on["target_value"])


def test_the_actor_weighs_entropy_against_the_smaller_value_and_leaves_the_critics_alone():
    module = loss()
    action, log_prob = action_and_log_prob(mean=1.0)
    value, _ = module.actor_loss(batch(2.0, 0.0, 0.0, -1.0))
    assert value.item() == pytest.approx(TEMPERATURE * log_prob - (2.0 + action), rel=1e-5)
    value.backward()
    gradients = {name: parameter.grad for name, parameter in module.named_parameters()}
    assert all((gradient is not None) == ("actor" in name) for name, gradient in gradients.items())


@pytest.mark.parametrize(("log_std", "sign"), [(-3.0, -1.0), (0.0, 1.0)])
def test_the_temperature_grows_where_the_entropy_is_below_its_goal(log_std, sign):
    module = loss(log_std=log_std, noise=0.0)
    losses = module(batch(0.0, 0.0, 0.0, 0.0))
    (gradient,) = torch.autograd.grad(losses["loss_alpha"], module.log_alpha)
    _, log_prob = action_and_log_prob(mean=0.0, std=math.exp(log_std), noise=0.0)
    assert gradient.item() == pytest.approx(-log_prob - GOAL, rel=1e-5)
    assert math.copysign(1.0, gradient.item()) == sign
    assert losses["entropy"].item() == pytest.approx(-log_prob, rel=1e-5)
    assert losses["alpha"].item() == pytest.approx(TEMPERATURE)


def test_log_probabilities_are_those_of_torch_distributions():
    env = make_env("half_cheetah")
    _, actor, critic = networks(env, SACConfig(hidden=[16]))
    module = DirectSACLoss(actor.double(), critic, gamma=GAMMA, target_entropy=GOAL)
    features = 3.0 * torch.randn(64, 17, dtype=torch.float64)
    action, log_prob = module._sample(features)
    normal = distributions.Normal(*actor[0].module(features))
    reference = distributions.TransformedDistribution(normal, distributions.TanhTransform())
    torch.testing.assert_close(log_prob, reference.log_prob(action).sum(-1))


def test_log_probabilities_are_finite_where_tanh_is_1():
    sampled = loss(noise=1.0, log_std=2.0)._sample(torch.tensor([[100.0]]))
    assert sampled[0].item() == 1.0
    assert 50.0 < sampled[1].item() < 200.0  # log (1 - tanh(u)^2) is log 4 - 2 u


def test_loss_and_learning_equal_those_of_torchrl():
    env = make_env("half_cheetah")
    _, actor, critic = networks(env, SACConfig(hidden=[32, 16]))
    ours = DirectSACLoss(actor, critic, gamma=GAMMA, target_entropy=-6.0, initial_temperature=0.3)
    settings = {"loss_function": "l2", "alpha_init": 0.3, "target_entropy": -6.0}
    theirs = SACLoss(deepcopy(actor), deepcopy(critic), **settings)
    theirs.load_state_dict(ours.state_dict())
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    updaters = [JointSoftUpdate(ours, eps=0.75), SoftUpdate(theirs, eps=0.75)]
    optimisers = [torch.optim.SGD(module.parameters(), lr=0.05) for module in (ours, theirs)]
    for step in range(3):
        flags = torch.rand(2, 64, 1) < 0.3
        outcome = {"features": torch.randn(64, 17), "reward": torch.randn(64, 1)}
        outcome |= {"terminated": flags[0], "done": flags.any(0)}
        columns = {"features": torch.randn(64, 17), "action": torch.rand(64, 6) - 0.5}
        sample = TensorDict(
            {**columns, "steps_to_next_obs": torch.randint(1, 5, (64,)), "next": outcome}, [64]
        )
        found = []
        for module, optimiser, updater in zip((ours, theirs), optimisers, updaters, strict=True):
            torch.manual_seed(step)  # of the actions
            losses = module(sample.clone())
            found.append({key: losses[key].detach().clone() for key in DirectSACLoss.reports})
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
            optimiser.step()
            optimiser.zero_grad()
            updater.step()
        torch.testing.assert_close(found[0], found[1])
        weights, expected = ours.state_dict(), theirs.state_dict()  # those of the target networks, too
        torch.testing.assert_close(dict(weights), {key: expected[key] for key in weights})


def test_tests_take_the_mean_and_training_explores():
    env = make_env("half_cheetah")
    _, actor, _ = networks(env, SACConfig(hidden=[16]))
    observed = TensorDict({"features": torch.randn(4, 17)}, [4])
    mean, _ = actor[0].module(observed["features"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actor(observed.clone())["action"], mean.tanh())
    with set_exploration_type(ExplorationType.RANDOM):
        first, second = (actor(observed.clone())["action"] for _ in range(2))
    assert not torch.equal(first, second)
    assert first.abs().max() <= 1.0


def test_deviations_have_limits():
    head = GaussianHead(nn.Identity())
    _, std = head(torch.tensor([[0.0, 0.0, -100.0, 100.0]]))
    assert std.log().tolist() == [pytest.approx(LOG_STD)]
