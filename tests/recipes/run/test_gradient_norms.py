"""The length of gradients, from Adam's own averages, against the gradients themselves."""

import pytest
import torch

from nht.recipes.agents.adam import LearnersAdam
from nht.recipes.run.gradient_norms import GradientNorms

BETA = 0.999


def weights(*shape):
    return [torch.nn.Parameter(torch.randn(*shape, 3)), torch.nn.Parameter(torch.randn(*shape))]


def descended(optimiser, groups, steps, learners=None):
    """Make steps along random gradients; the average of their squared lengths, the latest counting most, per group."""
    drawn = torch.Generator().manual_seed(0)
    means = [0.0 for _ in groups]
    for _ in range(steps):
        for place, group in enumerate(groups):
            squares = 0.0
            for weight in group:
                weight.grad = torch.randn(weight.shape, generator=drawn)
                flat = weight.grad.double().square()
                squares = squares + (flat.sum() if learners is None else flat.flatten(1).sum(1))
            means[place] = BETA * means[place] + (1 - BETA) * squares
        optimiser.step()
    return [(mean / (1 - BETA**steps)).sqrt() for mean in means]


def test_the_length_is_the_root_mean_square_of_the_gradients():
    groups = [weights(4), weights(2)]
    optimiser = torch.optim.Adam([{"params": group, "lr": 0.1} for group in groups], fused=True)
    norms = GradientNorms(optimiser, "actor", "critic")
    expected = descended(optimiser, groups, 7)
    (row,) = norms()
    assert list(row) == ["gradient_norm_actor", "gradient_norm_critic"]
    assert list(row.values()) == pytest.approx([float(value) for value in expected], rel=1e-5)


@pytest.mark.parametrize("rate", [0.1, torch.tensor([0.1, 0.2, 0.3])], ids=["one rate", "a rate each"])
def test_learners_have_lengths_of_their_own(rate):
    group = weights(3, 2)
    optimiser = LearnersAdam([(group, rate)])
    norms = GradientNorms(optimiser, learners=3)
    (expected,) = descended(optimiser, [group], 5, learners=3)
    rows = norms()
    assert [row["gradient_norm"] for row in rows] == pytest.approx(expected.tolist(), rel=1e-5)


def test_before_the_first_update_there_is_none():
    norms = GradientNorms(torch.optim.Adam(weights(4)))
    (row,) = norms()
    assert row["gradient_norm"] != row["gradient_norm"]


def test_looking_changes_no_step():
    torch.manual_seed(0)
    pairs = [weights(4)]
    pairs.append([torch.nn.Parameter(weight.detach().clone()) for weight in pairs[0]])
    optimisers = [torch.optim.Adam(group) for group in pairs]
    look = GradientNorms(optimisers[0])
    for optimiser, group in zip(optimisers, pairs, strict=True):
        descended(optimiser, [group], 3)
        look()
        descended(optimiser, [group], 3)
    assert all(torch.equal(one, other) for one, other in zip(*pairs, strict=True))


def test_names_must_go_with_the_groups():
    with pytest.raises(ValueError, match=r"has 1 groups, got the names \['actor', 'critic'\]"):
        GradientNorms(torch.optim.Adam(weights(4)), "actor", "critic")
