"""Return and length of episodes that batches cut anywhere, against a loop over single steps."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nht.recipes.run.episode_sums import EpisodeSums


def steps_of(seed, copies, steps):
    drawn = torch.Generator().manual_seed(seed)
    reward = torch.randn(copies, steps, generator=drawn)
    return reward, torch.rand(copies, steps, generator=drawn) < 0.2


def by_steps(reward, done):
    """Sums of return and length of all ended episodes, step by step."""
    returns, lengths = 0.0, 0
    for rewards, ends in zip(reward.double().tolist(), done.tolist(), strict=True):
        total, length = 0.0, 0
        for value, end in zip(rewards, ends, strict=True):
            total, length = total + value, length + 1
            if end:
                returns, lengths, total, length = returns + total, lengths + length, 0.0, 0
    return returns, lengths


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.integers(1, 4), st.lists(st.integers(1, 7), min_size=1, max_size=6))
def test_batches_of_any_length_give_the_sums_of_whole_episodes(seed, copies, batches):
    reward, done = steps_of(seed, copies, sum(batches))
    sums = EpisodeSums([copies])
    parts = zip(reward.split(batches, -1), done.split(batches, -1), strict=True)
    found = sum(sums.ended(*part) for part in parts)
    assert found.tolist() == pytest.approx(by_steps(reward, done), abs=1e-9)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_learners_are_counted_apart(seed):
    first, second = steps_of(seed, 3, 12), steps_of(seed + 1, 3, 12)
    reward, done = (torch.stack(pair) for pair in zip(first, second, strict=True))
    found = EpisodeSums([2, 3]).ended(reward, done)
    assert found.T.tolist() == [pytest.approx(by_steps(*part), abs=1e-9) for part in (first, second)]


def test_batches_of_single_workers_go_to_their_copies():
    reward, done = steps_of(3, 4, 20)
    whole, parts = EpisodeSums([4]), EpisodeSums([4])
    expected = whole.ended(reward, done)
    found = sum(
        parts.ended(reward[rows, start : start + 5], done[rows, start : start + 5], rows)
        for start in (0, 5, 10, 15)
        for rows in (slice(2, 4), slice(0, 2))
    )
    assert found.tolist() == pytest.approx(expected.tolist(), abs=1e-9)


def test_going_on_from_a_state_is_going_on():
    reward, done = steps_of(5, 3, 20)
    whole, stopped, resumed = (EpisodeSums([3]) for _ in range(3))
    whole.ended(reward[:, :9], done[:, :9])
    stopped.ended(reward[:, :9], done[:, :9])
    resumed.load_state_dict(stopped.state_dict())
    assert torch.equal(resumed.ended(reward[:, 9:], done[:, 9:]), whole.ended(reward[:, 9:], done[:, 9:]))


def test_an_episode_whose_beginning_is_not_known_has_no_return_and_the_next_one_has():
    sums = EpisodeSums([1])
    sums.load_state_dict({})  # of an earlier version
    ones, end = torch.ones(1, 3), torch.tensor([[False, False, True]])
    assert math.isnan(sums.ended(ones, end)[0])
    assert sums.ended(ones, end).tolist() == [3, 3]


def test_sums_of_other_copies_are_refused():
    with pytest.raises(ValueError, match=r"sums of episodes are \(2, 3\), expected \(2, 4\)"):
        EpisodeSums([4]).load_state_dict(EpisodeSums([3]).state_dict())
