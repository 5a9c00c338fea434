"""Critics of several quantiles: what they learn by, and what targets leave out."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from nht.envs import make_env
from nht.recipes.agents.critics import quantile_loss
from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss, networks


@given(batch=st.integers(1, 4), count=st.integers(1, 6), targets=st.integers(1, 6), seed=st.integers(0, 99))
def test_the_loss_is_that_of_each_pair(batch, count, targets, seed):
    torch.manual_seed(seed)
    found, target = 2 * torch.randn(batch, count), 2 * torch.randn(batch, targets)
    losses = quantile_loss(found, target)
    assert losses.shape == (batch, count, targets)
    for row in range(batch):
        for i in range(count):
            for j in range(targets):
                error = float(target[row, j] - found[row, i])
                huber = error**2 / 2 if abs(error) <= 1 else abs(error) - 0.5
                weight = abs((i + 0.5) / count - (error < 0))
                assert float(losses[row, i, j]) == pytest.approx(weight * huber, rel=1e-4, abs=1e-6)


def test_descent_finds_the_quantiles_of_what_is_drawn():
    generator = torch.Generator().manual_seed(0)
    samples = 50.0 * torch.randn(1, 4_000, generator=generator)  # far wider than the Huber loss is round
    found = nn.Parameter(torch.zeros(1, 5))
    optimiser = torch.optim.Adam([found], lr=1.0)
    for step in range(600):
        optimiser.param_groups[0]["lr"] = 1.0 if step < 400 else 0.1
        optimiser.zero_grad()
        quantile_loss(found, samples).mean().backward()
        optimiser.step()
    expected = stats.norm.ppf((np.arange(5) + 0.5) / 5, scale=50.0)
    np.testing.assert_allclose(found.detach().numpy()[0], expected, atol=3.0)


class Fixed(nn.Module):
    """Quantiles -1, 5, 2, 0, whatever the inputs."""

    def __init__(self):
        super().__init__()
        self.values = nn.Parameter(torch.tensor([-1.0, 5.0, 2.0, 0.0]))

    def forward(self, *inputs):
        return self.values + 0.0 * torch.cat(inputs, -1).sum(-1, keepdim=True)


@pytest.mark.parametrize(("dropped", "value"), [(0, 1.5), (1, 1 / 3), (3, -1.0)])
def test_targets_leave_the_largest_quantiles_out(dropped, value):
    actor = TensorDictModule(nn.Linear(2, 1), in_keys=["features"], out_keys=["action"])
    critic = TensorDictModule(Fixed(), in_keys=["features", "action"], out_keys=["state_action_value"])
    loss = PaperDDPGLoss(
        actor, critic, gamma=0.5, action_l2=0.0, reward_range=(-math.inf, math.inf), dropped=dropped
    )
    flags = torch.tensor([[False], [True]])
    outcome = {"features": torch.zeros(2, 2), "reward": torch.ones(2, 1), "done": flags, "terminated": flags}
    batch = TensorDict(
        {
            "features": torch.zeros(2, 2),
            "action": torch.zeros(2, 1),
            "steps_to_next_obs": torch.ones(2, dtype=torch.long),
            "next": TensorDict(outcome, [2]),
        },
        [2],
    )
    losses = loss(batch)
    torch.testing.assert_close(losses["target_value"], torch.tensor([1 + 0.5 * value, 1.0]))
    assert losses["loss_actor"].item() == pytest.approx(-1.5)  # the mean of all of them


def test_networks_with_norms_and_quantiles():
    env = make_env("half_cheetah", seed=0)
    for norm, actors, critics in (("none", 0, 0), ("critic", 0, 2), ("all", 2, 2)):
        _, actor, critic = networks(env, DDPGConfig(hidden=[8, 4], layer_norm=norm, quantiles=3))
        assert sum(isinstance(layer, nn.LayerNorm) for layer in actor.modules()) == actors
        assert sum(isinstance(layer, nn.LayerNorm) for layer in critic.modules()) == critics
        assert critic.module[-1].out_features == 3
    env.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"layer_norm": "both"}, r"algo.layer_norm must be none, critic or all, got 'both'\."),
        ({"quantiles": 0}, r"algo.quantiles must be at least 1, got 0\."),
        ({"dropped_quantiles": 1}, r"algo.dropped_quantiles must be less than algo.quantiles=1, got 1\."),
    ],
)
def test_wrong_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        DDPGConfig(**settings)
