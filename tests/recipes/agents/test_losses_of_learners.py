"""Losses, targets and minibatches of several learners: each learner's are what they would be alone."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from nht.envs import make_env
from nht.recipes.agents import ddpg, ppo
from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss
from nht.recipes.agents.norm import RunningNorm
from nht.recipes.agents.off_policy import JointSoftUpdate, mean_over
from nht.recipes.agents.ppo import GaussianPPOLoss, PPOConfig, advantage_estimator
from nht.recipes.agents.replay import minibatches, replay_buffer, storable
from nht.recipes.agents.returns import charge_failure, n_step_returns, return_range
from nht.recipes.agents.stacking import stacked
from nht.recipes.run.draws import Draws

LEARNERS, CPU = 3, torch.device("cpu")


@pytest.fixture(scope="module")
def env():
    return make_env("hopper", 1, seed=0)


def own(module, env, config):
    """Actor and critic of each learner."""
    return [module.networks(env, config)[1:] for _ in range(LEARNERS)]


def together(networks):
    return tuple(stacked(kind) for kind in zip(*networks, strict=True))


def of(settings, learner):
    return {
        name: float(value[learner]) if isinstance(value, torch.Tensor) else value
        for name, value in settings.items()
    }


def assert_gradients(whole, parts):
    """Of stacked networks, beside those of each learner's."""
    for kind, each in zip(whole, zip(*parts, strict=True), strict=True):
        for learner, network in enumerate(each):
            gradients = dict(kind.named_parameters())
            for name, parameter in network.named_parameters():
                torch.testing.assert_close(
                    gradients[name].grad[learner], parameter.grad, rtol=2e-5, atol=1e-6, msg=name
                )


# DDPG.

DDPG_SETTINGS = {
    "alike": {"gamma": 0.9, "action_l2": 0.1},
    "gamma": {"gamma": torch.tensor([0.9, 0.5, 0.99]), "action_l2": 0.1},
    "action_l2": {"gamma": 0.9, "action_l2": torch.tensor([0.0, 0.1, 2.0])},
    "both": {"gamma": torch.tensor([0.9, 0.5, 0.99]), "action_l2": torch.tensor([0.0, 0.1, 2.0])},
}


def replayed(size=24):
    rows = (LEARNERS, size)
    outcome = {
        "features": torch.randn(*rows, 11),
        "reward": -torch.rand(*rows, 1),
        "done": torch.zeros(*rows, 1, dtype=torch.bool),
        "terminated": torch.rand(*rows, 1) < 0.2,
    }
    return TensorDict(
        {
            "features": torch.randn(*rows, 11),
            "action": torch.rand(*rows, 3) * 2 - 1,
            "steps_to_next_obs": torch.randint(1, 4, rows),
            "next": TensorDict(outcome, rows),
        },
        rows,
    )


@pytest.mark.parametrize("rewards", [(-1.0, 0.0), (-float("inf"), float("inf"))])
@pytest.mark.parametrize("settings", DDPG_SETTINGS.values(), ids=DDPG_SETTINGS)
@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("more", [{}, {"layer_norm": "all", "quantiles": 5, "dropped_quantiles": 2}])
def test_losses_of_ddpg(env, settings, rewards, bfloat16, more):
    networks = own(ddpg, env, DDPGConfig(hidden=[16, 16], bfloat16=bfloat16, **more))
    stack = together(networks)
    settings = settings | {"dropped": more.get("dropped_quantiles", 0)}
    loss = PaperDDPGLoss(*stack, **settings, reward_range=rewards)
    batch = replayed()
    losses = loss(batch)
    assert losses["loss_value"].shape == losses["loss_actor"].shape == (LEARNERS,)
    (losses["loss_value"].sum() + losses["loss_actor"].sum()).backward()
    tolerance = {"rtol": 2e-2, "atol": 2e-2} if bfloat16 else {"rtol": 1e-5, "atol": 1e-6}
    for learner, pair in enumerate(networks):
        alone = PaperDDPGLoss(*pair, **of(settings, learner), reward_range=rewards)(batch[learner])
        for name in ("loss_value", "loss_actor", "target_value"):
            torch.testing.assert_close(losses[name][learner], alone[name], **tolerance)
        (alone["loss_value"] + alone["loss_actor"]).backward()
    if not bfloat16:
        assert_gradients(stack, networks)


def test_minibatches_filled_up_count_for_what_they_are(env):
    networks, sizes = own(ddpg, env, DDPGConfig(hidden=[16])), (3, 8, 5)
    stack = together(networks)
    loss = PaperDDPGLoss(*stack, gamma=0.9, action_l2=0.1)
    batch = replayed(max(sizes))
    counts = torch.tensor(sizes).unsqueeze(-1)
    batch["weight"] = (torch.arange(max(sizes)) < counts) / counts
    losses = loss(batch)
    (losses["loss_value"].sum() + losses["loss_actor"].sum()).backward()
    for learner, (pair, size) in enumerate(zip(networks, sizes, strict=True)):
        rows = batch[learner, :size].exclude("weight")
        alone = PaperDDPGLoss(*pair, gamma=0.9, action_l2=0.1)(rows)
        for name in ("loss_value", "loss_actor"):
            torch.testing.assert_close(losses[name][learner], alone[name])
        (alone["loss_value"] + alone["loss_actor"]).backward()
    assert_gradients(stack, networks)


@pytest.mark.parametrize("polyak", [0.9, torch.tensor([0.0, 0.5, 1.0])])
def test_targets_follow_each_at_its_own_pace(env, polyak):
    networks = own(ddpg, env, DDPGConfig(hidden=[8]))
    loss = PaperDDPGLoss(*together(networks), gamma=0.9, action_l2=0.0)
    alone = [PaperDDPGLoss(*pair, gamma=0.9, action_l2=0.0) for pair in networks]
    target = JointSoftUpdate(loss, eps=polyak)
    targets = [
        JointSoftUpdate(each, eps=float(polyak[learner]) if isinstance(polyak, torch.Tensor) else polyak)
        for learner, each in enumerate(alone)
    ]
    for step in range(2):
        for each in (loss, *alone):
            for parameter in each.parameters():
                parameter.data += 0.1 * (step + 1)
        for each in (target, *targets):
            each.step()
    for name in ("target_actor_network_params", "target_value_network_params"):
        whole = getattr(loss, name)
        for learner, each in enumerate(alone):
            for key, value in getattr(each, name).items(True, True):
                torch.testing.assert_close(whole[key][learner], value)


def steps(rows, size=2):
    outcome = {"observation": torch.randn(*rows, size), "reward": torch.randn(*rows, 1)}
    flags = {name: torch.zeros(*rows, 1, dtype=torch.bool) for name in ("done", "terminated", "failure")}
    columns = {"observation": torch.randn(*rows, size), "action": torch.rand(*rows, 1)}
    columns["steps_to_next_obs"] = torch.ones(rows, dtype=torch.long)
    return TensorDict({**columns, "next": TensorDict(outcome | flags, rows)}, rows)


@pytest.mark.parametrize("sizes", [(4, 4, 4), (4, 2, 7)])
def test_minibatches_are_those_that_each_would_draw(sizes):
    seeds, draws, collected = (1, 5, 9), Draws((1, 5, 9), CPU), [steps((LEARNERS, 2, 15)) for _ in range(2)]
    norm = RunningNorm(2, learners=LEARNERS)
    buffer = replay_buffer(50, CPU)  # full, and written over
    for data in collected:
        norm.update(data["observation"])
        buffer.extend(storable(data))
    found = list(
        minibatches(buffer, 3, sizes, TensorDictModule(norm, ["observation"], ["features"]), CPU, draws)
    )
    assert [batch.shape for batch in found] == 3 * [(LEARNERS, max(sizes))]
    for learner, (seed, size) in enumerate(zip(seeds, sizes, strict=True)):
        alone, own_norm = replay_buffer(50, CPU), RunningNorm(2)
        for data in collected:
            own_norm.update(data[learner]["observation"])
            alone.extend(storable(data[learner]))
        features = TensorDictModule(own_norm, ["observation"], ["features"])
        torch.manual_seed(seed)
        for batch, expected in zip(found, minibatches(alone, 3, size, features, CPU), strict=True):
            rows = batch[learner, :size]
            for key in ("observation", "action", "features", ("next", "features"), ("next", "reward")):
                torch.testing.assert_close(rows[key], expected[key])
            values = torch.randn(LEARNERS, max(sizes), 1)
            torch.testing.assert_close(mean_over(batch, values)[learner], values[learner, :size].mean())


def test_what_fills_a_minibatch_up_is_its_learners_own():
    collected, buffer = steps((LEARNERS, 2, 5)), replay_buffer(10, CPU)
    collected["observation"] = (
        torch.arange(float(LEARNERS)).view(-1, 1, 1, 1).expand(LEARNERS, 2, 5, 2).clone()
    )
    collected["action"][0] = torch.nan  # of a learner that is lost
    buffer.extend(storable(collected))
    features = TensorDictModule(torch.nn.Identity(), ["observation"], ["features"])
    for batch in minibatches(buffer, 4, (6, 2, 3), features, CPU, Draws((0, 1, 2), CPU)):
        for learner in range(LEARNERS):
            assert batch["observation"][learner].eq(learner).all()
        assert mean_over(batch, batch["action"])[1:].isfinite().all()


GAMMAS = torch.tensor([0.9, 0.5, 0.99])


@pytest.mark.parametrize("gamma", [0.9, GAMMAS])
def test_what_is_made_of_rewards(gamma):
    each_gamma = gamma.tolist() if isinstance(gamma, torch.Tensor) else LEARNERS * [gamma]
    data = steps((LEARNERS, 2, 8))
    data["next", "done"][..., 3, :] = True
    data["next", "terminated"][:, 0, 3] = data["next", "failure"][:, 0, 3] = True
    alone = [data[learner].clone() for learner in range(LEARNERS)]
    found = n_step_returns(gamma, 3)(charge_failure(data, gamma, (-1.0, 0.5)))
    for learner, (part, own_gamma) in enumerate(zip(alone, each_gamma, strict=True)):
        expected = n_step_returns(own_gamma, 3)(charge_failure(part, own_gamma, (-1.0, 0.5)))
        for key in (("next", "reward"), ("next", "observation"), "steps_to_next_obs"):
            torch.testing.assert_close(found[learner][key], expected[key])
    low, high = return_range((-1.0, 0.5), gamma)
    bounds = [return_range((-1.0, 0.5), each) for each in each_gamma]
    torch.testing.assert_close(
        torch.as_tensor(low).expand(LEARNERS), torch.tensor([low for low, _ in bounds])
    )
    torch.testing.assert_close(
        torch.as_tensor(high).expand(LEARNERS), torch.tensor([top for _, top in bounds])
    )


# PPO.

PPO_ALIKE = {"clip": 0.2, "critic_coeff": 0.5, "entropy_coeff": 0.01}
PPO_OWN = {
    "clip": torch.tensor([0.1, 0.2, 0.4]),
    "critic_coeff": torch.tensor([0.5, 1.0, 0.0]),
    "entropy_coeff": torch.tensor([0.0, 0.01, 0.1]),
}
PPO_SETTINGS = {"alike": PPO_ALIKE, "all": PPO_OWN} | {
    name: PPO_ALIKE | {name: values} for name, values in PPO_OWN.items()
}


@pytest.mark.parametrize("clip_value", [False, True])
@pytest.mark.parametrize("settings", PPO_SETTINGS.values(), ids=PPO_SETTINGS)
def test_losses_of_ppo(env, settings, clip_value):
    networks = own(ppo, env, PPOConfig(hidden=[16]))
    for learner, (actor, _) in enumerate(networks):
        actor.module.log_std.data += 0.3 * learner
    stack, rows = together(networks), (LEARNERS, 32)
    loss = GaussianPPOLoss(*stack, **settings, clip_value=clip_value)
    batch = TensorDict({"features": torch.randn(*rows, 11)}, rows)
    batch["sample"] = 0.2 * torch.randn(*rows, 3)
    with torch.no_grad():
        batch["sample_log_prob"] = stack[0].module.log_prob(batch["features"], batch["sample"])[0]
        batch["sample_log_prob"] += 0.3 * torch.randn(rows)
    for name in ("advantage", "value_target", "state_value"):
        batch[name] = torch.randn(*rows, 1)
    losses = loss(batch)
    losses["loss"].sum().backward()
    for learner, pair in enumerate(networks):
        alone = GaussianPPOLoss(*pair, **of(settings, learner), clip_value=clip_value)(batch[learner])
        for name in ("loss", *GaussianPPOLoss.reports):
            torch.testing.assert_close(losses[name][learner], alone[name], rtol=1e-5, atol=1e-6)
        alone["loss"].backward()
    assert_gradients(stack, networks)


@pytest.mark.parametrize("gamma", [0.9, GAMMAS])
@pytest.mark.parametrize("lmbda", [0.8, torch.tensor([0.8, 1.0, 0.3])])
def test_advantages(gamma, lmbda):
    rows = (LEARNERS, 2, 9)
    data = steps(rows)
    data["next", "done"][..., 4, :] = True
    data["next", "terminated"][:, 1, 4] = True
    data["state_value"], data["next", "state_value"] = torch.randn(*rows, 1), torch.randn(*rows, 1)
    found = advantage_estimator(gamma, lmbda)(data.clone())
    for learner in range(LEARNERS):
        told = of({"gamma": gamma, "lmbda": lmbda}, learner)
        expected = advantage_estimator(**told)(data[learner].clone())
        for name in ("advantage", "value_target"):
            torch.testing.assert_close(found[name][learner], expected[name])
