"""Generators of several learners: each draws what it would draw alone."""

import copy
from dataclasses import dataclass

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from nht.envs import make_env
from nht.recipes.agents.off_policy import exploring
from nht.recipes.run.draws import OTHERS, Draws

CPU = torch.device("cpu")
SEEDS = (5, 0, 77)
SHAPES = st.lists(st.integers(1, 6), min_size=0, max_size=3)


def alone(seed, draw):
    """What torch itself draws from that seed."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return draw()


@pytest.mark.parametrize(
    "draw",
    [
        lambda *shape: torch.randn(*shape),
        lambda *shape: torch.randn(shape),
        lambda *shape: torch.randn(size=shape),
        lambda *shape: torch.rand(*shape),
        lambda *shape: torch.rand(shape, dtype=torch.float64),
        lambda *shape: torch.randn_like(torch.ones(shape)),
        lambda *shape: torch.rand_like(torch.ones(shape)),
        lambda *shape: torch.empty(shape).normal_(),
        lambda *shape: torch.empty(shape).normal_(2.0, 0.5),
        lambda *shape: torch.empty(shape).uniform_(),
        lambda *shape: torch.empty(shape).uniform_(-3.0, 1.0),
        lambda *shape: torch.empty(shape).normal_(generator=None),
    ],
)
@given(shape=SHAPES)
def test_each_learner_draws_what_it_would_draw_alone(draw, shape):
    with Draws(SEEDS, CPU).for_all():
        found = [draw(len(SEEDS), *shape) for _ in range(2)]
    for learner, seed in enumerate(SEEDS):
        own = alone(seed, lambda: [draw(1, *shape)[0] for _ in range(2)])
        for each, expected in zip(found, own, strict=True):
            assert torch.equal(each[learner], expected)


def test_in_place_draws_go_to_the_tensor_they_are_called_on():
    values = torch.zeros(3, 4)
    with Draws(SEEDS, CPU).for_all():
        assert values.normal_() is values
    assert values.ne(0).all()


def test_networks_are_drawn_as_alone():
    draws = Draws(SEEDS, CPU)
    before = torch.get_rng_state()
    for learner, seed in enumerate(SEEDS):
        with draws.of(learner):
            first = nn.Linear(3, 4)
        with draws.of(learner):
            second = nn.Linear(4, 2)
        own = alone(seed, lambda: (nn.Linear(3, 4), nn.Linear(4, 2)))
        assert torch.equal(first.weight, own[0].weight)
        assert torch.equal(second.bias, own[1].bias)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_learner_that_fails_to_draw_leaves_torch_as_it_was():
    draws, before = Draws(SEEDS, CPU), torch.get_rng_state()
    with pytest.raises(RuntimeError, match="negative dimension"), draws.of(1):
        torch.rand(torch.randint(1, 3, ()) - 5)
    assert torch.equal(torch.get_rng_state(), before)


@given(high=st.integers(1, 1000), counts=st.lists(st.integers(0, 20), min_size=3, max_size=3))
def test_integers_and_orders_are_each_learners(high, counts):
    draws = Draws(SEEDS, CPU)
    integers, orders = draws.integers(high, counts), draws.orders(17)
    for learner, (seed, count) in enumerate(zip(SEEDS, counts, strict=True)):
        own = alone(seed, lambda count=count: (torch.randint(0, high, (count,)), torch.randperm(17)))
        assert torch.equal(integers[learner], own[0])
        assert torch.equal(orders[learner], own[1])


def test_what_others_draw_changes_nothing():
    few, many = Draws(SEEDS[:1], CPU), Draws(SEEDS, CPU)
    few.integers(10, [4]), many.integers(10, [4, 9, 1])
    with few.for_all():
        first = torch.randn(1, 5)
    with many.for_all():
        assert torch.equal(torch.randn(3, 5)[0], first[0])


def test_they_go_on_from_their_state():
    draws, later = Draws(SEEDS, CPU), Draws((0, 0, 0), CPU)
    draws.orders(5)
    state = draws.state_dict()
    kept = {name: value.clone() for name, value in state.items()}
    expected = draws.orders(50)
    later.load_state_dict(state)
    assert torch.equal(later.orders(50), expected)
    assert all(torch.equal(value, kept[name]) for name, value in state.items())


def drawn(draws, calls=5):
    """Normal and uniform tensors of two shapes, in turn."""
    with draws.for_all():
        learners = len(draws.generators)
        return [
            (torch.randn(learners, 2), torch.rand(learners, 2), torch.zeros(learners, 3).normal_(2.0, 0.1))
            for _ in range(calls)
        ]


def assert_equal(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


@pytest.mark.parametrize("ahead", [2, 3, 64])
def test_draws_ahead_of_time_do_not_depend_on_others(ahead):
    together = drawn(Draws(SEEDS, CPU, ahead))
    for learner, seed in enumerate(SEEDS):
        own = drawn(Draws([seed], CPU, ahead))
        assert_equal([[values[learner : learner + 1] for values in each] for each in together], own)
    values = torch.cat([each[2].flatten() for each in drawn(Draws(SEEDS, CPU, ahead), 200)])
    assert len(values.unique()) > 0.99 * len(values)  # none is given out twice
    assert abs(float(values.mean()) - 2.0) < 0.02
    assert abs(float(values.std()) - 0.1) < 0.01


@pytest.mark.parametrize("ahead", [2, 3, 64])
def test_draws_ahead_of_time_go_on_from_their_state(ahead):
    draws, later = Draws(SEEDS, CPU, ahead), Draws((0, 0, 0), CPU, ahead)
    drawn(draws)
    later.load_state_dict(copy.deepcopy(draws.state_dict()))
    assert_equal(drawn(later, 100), drawn(draws, 100))


def test_the_generators_of_another_number_of_learners():
    with pytest.raises(ValueError, match="zip"):
        Draws(SEEDS, CPU).load_state_dict(Draws(SEEDS[:2], CPU).state_dict())


# Draws that would make learners depend on each other are refused.


@pytest.mark.parametrize(
    "draw",
    [
        lambda: torch.randint(0, 5, (3, 2)),
        lambda: torch.randperm(3),
        lambda: torch.bernoulli(torch.full((3, 2), 0.5)),
        lambda: torch.normal(torch.zeros(3, 2), torch.ones(3, 2)),
        lambda: torch.multinomial(torch.ones(3, 2), 1),
        lambda: torch.empty(3, 2).exponential_(),
        lambda: torch.empty(3, 2).bernoulli_(0.5),
        lambda: torch.empty(3, 2).random_(),
        lambda: torch.poisson(torch.ones(3, 2)),
    ],
)
def test_draws_without_a_part_for_each_learner(draw):
    with (
        Draws(SEEDS, CPU).for_all(),
        pytest.raises(RuntimeError, match="draws for all learners together: they would not be independent"),
    ):
        draw()
    draw()  # elsewhere it may


@pytest.mark.parametrize("shape", [(2, 3), (4,), ()])
def test_a_tensor_without_a_row_for_each_learner(shape):
    with (
        Draws(SEEDS, CPU).for_all(),
        pytest.raises(RuntimeError, match="the first dimension must be that of the 3 learners"),
    ):
        torch.randn(shape)


@pytest.mark.parametrize(
    "draw",
    [
        lambda: nn.init.normal_(torch.empty(3, 2)),
        lambda: nn.functional.dropout(torch.ones(3, 20)),
        lambda: nn.functional.gumbel_softmax(torch.ones(3, 2)),
    ],
)
def test_draws_that_torch_hides_are_found_out(draw):
    with (
        pytest.raises(
            RuntimeError, match="something drew from torch's own generator for all learners together"
        ),
        Draws(SEEDS, CPU).for_all(),
    ):
        draw()


def test_whoever_brings_a_generator_draws_from_it():
    drawn = [torch.Generator().manual_seed(1) for _ in range(2)]
    draws = Draws(SEEDS, CPU)
    with draws.for_all():
        found = torch.rand(5, generator=drawn[0]), torch.zeros(4).normal_(generator=drawn[0])
    own = torch.rand(5, generator=drawn[1]), torch.zeros(4).normal_(generator=drawn[1])
    assert all(torch.equal(one, two) for one, two in zip(found, own, strict=True))
    assert torch.equal(draws.orders(9), Draws(SEEDS, CPU).orders(9))


def test_every_draw_of_torch_is_known():
    """Draws of a tensor method that nobody thought of would be drawn for all: a new one must be sorted in."""
    from nht.recipes.run.draws import FRESH, IN_PLACE, LIKE

    known = {func.__name__ for func in (*OTHERS, *FRESH, *LIKE, *IN_PLACE)}
    found = {name for name in dir(torch) if name.startswith("rand") and callable(getattr(torch, name))}
    assert found - {"random"} <= known


# Exploration.


@dataclass
class Noise:
    exploration_noise: float | Tensor
    noise_memory: float | Tensor
    random_action: float | Tensor


class Still(nn.Module):
    def forward(self, observation):
        return 0.1 * observation[..., :3]


def explored(env, noise, drawing, steps=12):
    """Actions ``(steps, *batch, k)`` that were drawn within ``drawing()``; a copy begins anew on the way."""
    policy = exploring(TensorDictModule(Still(), ["observation"], ["action"]), env, noise)
    current = TensorDict({"observation": torch.ones(*env.batch_size, 11)}, env.batch_size)
    current["is_init"] = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
    actions = []
    for step in range(steps):
        current["is_init"][..., 0, :] = step == 5
        with drawing():
            current = policy(current)
        actions.append(current["action"].clone())
    return torch.stack(actions)


OWN = {
    "exploration_noise": [0.3, 0.0, 1.0],
    "noise_memory": [10.0, 1.0, 3.0],
    "random_action": [0.1, 0.5, 0.0],
}


@pytest.mark.parametrize("differing", [(), *((name,) for name in OWN), tuple(OWN)])
def test_each_explores_as_it_would_alone(differing):
    told = {name: torch.tensor(values) if name in differing else values[0] for name, values in OWN.items()}
    draws = Draws(SEEDS, CPU)
    together = explored(make_env("hopper", 4, seed=list(SEEDS)), Noise(**told), draws.for_all)
    env = make_env("hopper", 4, seed=0)
    for learner, seed in enumerate(SEEDS):
        mine = {name: values[learner if name in differing else 0] for name, values in OWN.items()}
        alone = Draws([seed], CPU)
        own = explored(env, Noise(**mine), lambda alone=alone: alone.of(0))
        torch.testing.assert_close(together[:, learner], own, rtol=1e-6, atol=1e-6)
    assert not torch.equal(together[:, 0], together[:, 2])
