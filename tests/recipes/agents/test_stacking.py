"""Networks, normalisers and optimisers of several learners: each computes what it would alone."""

import copy

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP

from nht.recipes.agents.adam import LearnersAdam, clip_gradients
from nht.recipes.agents.norm import ReturnNorm, RunningNorm
from nht.recipes.agents.perceptrons import HalfPrecisionMLP
from nht.recipes.agents.ppo import GaussianActor
from nht.recipes.agents.settings import beside, largest
from nht.recipes.agents.stacking import of_learner, stacked

SIZES = st.integers(1, 9)


def networks(learners, size, hidden, out, kind=MLP, seed=0, normed=False):
    torch.manual_seed(seed)
    norm = {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": width} for width in hidden]}
    own = norm if normed and hidden else {}
    several = [kind(size, out, num_cells=hidden, activation_class=nn.ReLU, **own) for _ in range(learners)]
    for layer in (layer for network in several for layer in network if isinstance(layer, nn.LayerNorm)):
        nn.init.normal_(layer.weight), nn.init.normal_(layer.bias)
    return several


@given(
    learners=st.integers(1, 5),
    size=SIZES,
    hidden=st.lists(SIZES, max_size=3),
    out=SIZES,
    batch=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    seed=st.integers(0, 99),
    normed=st.booleans(),
)
def test_a_stacked_network_is_each_network_on_its_own_rows(learners, size, hidden, out, batch, seed, normed):
    own = networks(learners, size, hidden, out, seed=seed, normed=normed)
    inputs = torch.randn(learners, *batch, size)
    outputs = stacked(own)(inputs)
    assert outputs.shape == (learners, *batch, out)
    for network, rows, found in zip(own, inputs, outputs, strict=True):
        torch.testing.assert_close(found, network(rows), rtol=1e-5, atol=1e-5)


def test_tanh_and_its_gradient_are_those_of_each_network():
    torch.manual_seed(0)
    inputs = torch.cat([torch.linspace(-12, 12, 4001), torch.tensor([-1e30, 0.0, 1e30])])
    inputs = inputs.repeat(2, 1).requires_grad_()
    cotangent = torch.rand_like(inputs)
    found = stacked([nn.Sequential(nn.Tanh()), nn.Sequential(nn.Tanh())])(inputs)
    (gradient,) = torch.autograd.grad(found, inputs, cotangent)
    exact = inputs.detach().double().requires_grad_()
    (exactly,) = torch.autograd.grad(exact.tanh(), exact, cotangent.double())
    torch.testing.assert_close(found.double(), exact.tanh(), rtol=0, atol=2e-7)
    torch.testing.assert_close(gradient.double(), exactly, rtol=0, atol=4e-7)


@given(learners=st.integers(1, 4), hidden=st.lists(SIZES, max_size=2), seed=st.integers(0, 99))
def test_the_state_of_a_learner_is_that_of_its_network(learners, hidden, seed):
    own = networks(learners, 3, hidden, 2, seed=seed)
    state = stacked(own).state_dict()
    for learner, network in enumerate(own):
        found = of_learner(state, learner)
        assert found.keys() == network.state_dict().keys()
        assert all(torch.equal(found[name], value) for name, value in network.state_dict().items())
        copy.deepcopy(network).load_state_dict(found)


def test_a_learners_state_is_a_copy():
    state = stacked(networks(2, 3, [4], 2)).state_dict()
    kept = {name: value.clone() for name, value in state.items()}
    for value in of_learner(state, 1).values():
        value.zero_()
    assert all(torch.equal(value, kept[name]) for name, value in state.items())


def test_stacking_leaves_the_networks_alone():
    own = networks(2, 3, [4], 2)
    kept = copy.deepcopy(own)
    for parameter in stacked(own).parameters():
        parameter.data.zero_()
    for network, before in zip(own, kept, strict=True):
        assert all(
            torch.equal(one, two) for one, two in zip(network.parameters(), before.parameters(), strict=True)
        )


@pytest.mark.parametrize("normed", [False, True])
def test_gradients_are_those_of_each_network(normed):
    own = networks(3, 4, [8, 8], 2, normed=normed)
    together = stacked(own)
    inputs = torch.randn(3, 16, 4)
    together(inputs).square().mean((1, 2)).sum().backward()
    gradients = {name: parameter.grad for name, parameter in together.named_parameters()}
    for learner, network in enumerate(own):
        network(inputs[learner]).square().mean().backward()
        for name, parameter in network.named_parameters():
            torch.testing.assert_close(gradients[name][learner], parameter.grad, rtol=1e-5, atol=1e-7)


def test_networks_of_half_precision():
    own = networks(3, 5, [16, 16], 2, HalfPrecisionMLP)
    together, inputs = stacked(own), torch.randn(3, 20, 5)
    assert isinstance(together, HalfPrecisionMLP)
    for network, rows, found in zip(own, inputs, together(inputs), strict=True):
        torch.testing.assert_close(found, network(rows), rtol=2e-2, atol=2e-2)
    single = stacked(networks(3, 5, [16, 16], 2))  # of the same weights
    assert not torch.allclose(together(inputs), single(inputs), rtol=1e-5, atol=1e-6)


def test_two_inputs_side_by_side():
    own, features, action = networks(2, 7, [8], 1), torch.randn(2, 5, 4), torch.randn(2, 5, 3)
    found = stacked(own)(features, action)
    for learner, network in enumerate(own):
        torch.testing.assert_close(found[learner], network(features[learner], action[learner]))


def test_a_gaussian_actors_deviation_is_each_learners():
    actors = [
        GaussianActor(network, 2, deviation)
        for network, deviation in zip(networks(3, 4, [8], 2), (0.1, 0.5, 2.0), strict=True)
    ]
    together = stacked(actors)
    features, sample = torch.randn(3, 5, 6, 4), torch.randn(3, 5, 6, 2)
    log_prob, entropy = together.log_prob(features, sample)
    assert (log_prob.shape, entropy.shape) == ((3, 5, 6), (3,))
    for learner, actor in enumerate(actors):
        own = actor.log_prob(features[learner], sample[learner])
        torch.testing.assert_close((log_prob[learner], entropy[learner]), own)


def test_what_needs_no_gradient_still_needs_none():
    own = networks(2, 3, [4], 2)
    for network in own:
        network.mark = nn.Parameter(torch.ones(2), requires_grad=False)
        network.register_buffer("place", torch.arange(3))
    together = stacked(own)
    assert not together.mark.requires_grad
    assert together.place.shape == (2, 3)


@pytest.mark.parametrize(
    "other", [MLP(3, 2, num_cells=[5]), MLP(3, 2, num_cells=[4, 4]), MLP(4, 2, num_cells=[4])]
)
def test_networks_of_other_shapes(other):
    own = networks(2, 3, [4], 2)
    with pytest.raises(ValueError, match=r"networks of one shape: learner 0 has .*\(4, 3\).*, learner 2 has"):
        stacked([*own, other])


# Normalisers.


@given(
    learners=st.integers(1, 4),
    batch=st.lists(st.integers(1, 5), min_size=1, max_size=2),
    size=SIZES,
    updates=st.integers(1, 4),
    seed=st.integers(0, 99),
)
def test_a_running_norm_is_each_learners_own(learners, batch, size, updates, seed):
    torch.manual_seed(seed)
    together = RunningNorm(size, 3.0, learners=learners)
    own = [RunningNorm(size, 3.0) for _ in range(learners)]
    for _ in range(updates):
        seen = torch.randn(learners, *batch, size) * 4.0 + torch.arange(learners).view(
            -1, *[1] * len(batch), 1
        )
        together.update(seen)
        for norm, rows in zip(own, seen, strict=True):
            norm.update(rows)
    for learner, norm in enumerate(own):
        for name, value in norm.state_dict().items():
            torch.testing.assert_close(of_learner(together.state_dict(), learner)[name], value)
    for shape in (batch, [2], [3, 2, 2]):
        observation = 5.0 * torch.randn(learners, *shape, size)
        for norm, rows, found in zip(own, observation, together(observation), strict=True):
            torch.testing.assert_close(found, norm(rows))


def test_stacked_norms_are_norms_of_learners():
    own = [RunningNorm(3) for _ in range(2)]
    for norm in own:
        norm.update(torch.randn(5, 3) * 3.0)
    together, seen = stacked(own), torch.randn(2, 4, 3)
    together.update(seen)
    for norm, rows in zip(own, seen, strict=True):
        norm.update(rows)
    found = together(seen)
    assert all(torch.equal(found[learner], own[learner](seen[learner])) for learner in range(2))


@pytest.mark.parametrize("gamma", [0.9, torch.tensor([0.9, 0.5, 0.99])])
def test_a_return_norm_is_each_learners_own(gamma):
    together = ReturnNorm(4, gamma, clip=2.0, learners=3)
    each_gamma = gamma.tolist() if isinstance(gamma, torch.Tensor) else 3 * [gamma]
    own = [ReturnNorm(4, alone, clip=2.0) for alone in each_gamma]
    for _ in range(3):
        outcome = {"reward": torch.randn(3, 4, 6, 1) * 5.0, "done": torch.rand(3, 4, 6, 1) < 0.2}
        data = TensorDict({"next": TensorDict(outcome, [3, 4, 6])}, [3, 4, 6])
        parts = [data[learner].clone() for learner in range(3)]
        together(data)
        for learner, (norm, part) in enumerate(zip(own, parts, strict=True)):
            expected = norm(part)["next", "reward"]
            torch.testing.assert_close(data["next", "reward"][learner], expected)
            torch.testing.assert_close(together.returns[learner], norm.returns)


# Optimisers.


def losses(parameters, target):
    return [(weight - target).square().sum() + weight.sin().sum() for weight in parameters]


@pytest.mark.parametrize("rates", [0.01, torch.tensor([0.001, 0.01, 0.1])])
@pytest.mark.parametrize("decayed", [False, True])
def test_steps_are_those_of_an_optimiser_for_each(rates, decayed):
    torch.manual_seed(1)
    shapes = [(4, 3), (4,)]
    together = [nn.Parameter(torch.randn(3, *shape)) for shape in shapes]
    own = [[nn.Parameter(whole.data[learner].clone()) for whole in together] for learner in range(3)]
    each_rate = rates.tolist() if isinstance(rates, torch.Tensor) else 3 * [rates]
    ours = LearnersAdam([(together, rates)], eps=1e-5)
    theirs = [torch.optim.Adam(mine, lr=rate, eps=1e-5) for mine, rate in zip(own, each_rate, strict=True)]
    for step in range(20):
        target = torch.randn(())
        if decayed:
            ours.decay(1 - step / 20)
            for adam, rate in zip(theirs, each_rate, strict=True):
                adam.param_groups[0]["lr"] = rate * (1 - step / 20)
        torch.stack(losses(together, target)).sum().backward()
        ours.step()
        ours.zero_grad()
        for mine, adam in zip(own, theirs, strict=True):
            torch.stack(losses(mine, target)).sum().backward()
            adam.step()
            adam.zero_grad()
    for learner, mine in enumerate(own):
        for whole, part in zip(together, mine, strict=True):
            torch.testing.assert_close(whole.data[learner], part.data, rtol=1e-5, atol=1e-6)


def test_networks_may_have_rates_of_their_own():
    actor, critic = nn.Parameter(torch.ones(2, 3)), nn.Parameter(torch.ones(2, 3))
    adam = LearnersAdam([([actor], torch.tensor([0.1, 0.2])), ([critic], 0.3)])
    (actor.sum() + critic.sum()).backward()
    adam.step()
    torch.testing.assert_close(1.0 - actor.data[:, 0], torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(1.0 - critic.data[:, 0], torch.tensor([0.3, 0.3]))


def test_an_optimiser_of_learners_goes_on_from_its_state():
    rates = torch.tensor([0.01, 0.1])
    first = nn.Parameter(torch.ones(2, 3))
    adam = LearnersAdam([([first], rates)])

    def step(parameter, optimiser):
        (parameter**3).sum().backward()
        optimiser.step()
        optimiser.zero_grad()

    step(first, adam)
    second = nn.Parameter(first.data.clone())
    later = LearnersAdam([([second], rates)])
    later.load_state_dict(copy.deepcopy(adam.state_dict()))
    step(first, adam)
    step(second, later)
    assert torch.equal(first, second)


@given(
    learners=st.integers(1, 4),
    norm=st.floats(0.01, 10.0),
    size=st.floats(0.01, 10.0),
    seed=st.integers(0, 99),
    own=st.booleans(),
)
def test_gradients_are_clipped_for_each(learners, norm, size, seed, own):
    torch.manual_seed(seed)
    norms = norm * (1.0 + torch.arange(learners)) if own else norm
    parameters = [nn.Parameter(torch.zeros(learners, *shape)) for shape in [(3, 2), (2,)]]
    for parameter in parameters:
        parameter.grad = size * torch.randn_like(parameter)
    alone = []
    for learner in range(learners):
        parts = [nn.Parameter(torch.zeros_like(whole[learner])) for whole in parameters]
        for part, whole in zip(parts, parameters, strict=True):
            part.grad = whole.grad[learner].clone()
        nn.utils.clip_grad_norm_(parts, float(norms[learner]) if own else norm)
        alone.append(parts)
    clip_gradients(parameters, norms, learners)
    for learner, parts in enumerate(alone):
        for part, whole in zip(parts, parameters, strict=True):
            torch.testing.assert_close(whole.grad[learner], part.grad, rtol=1e-5, atol=1e-7)


def test_a_gradient_that_is_no_number_is_its_learners_alone():
    parameter = nn.Parameter(torch.zeros(2, 3))
    parameter.grad = torch.tensor([[torch.nan, 1.0, 1.0], [3.0, 0.0, 4.0]])
    clip_gradients([parameter], 1.0, 2)
    torch.testing.assert_close(parameter.grad[1], torch.tensor([0.6, 0.0, 0.8]))


def test_the_shape_of_a_setting():
    assert beside(0.5, torch.ones(2, 3)) == 0.5
    assert beside(torch.ones(2), torch.ones(2, 3, 4)).shape == (2, 1, 1)
    assert (largest(0.5), largest(torch.tensor([1.0, 3.0]))) == (0.5, 3.0)
