"""What is said of many scores: agreement with enumeration and with values worked out by hand."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from nht.recipes.study.scores import (
    best_of,
    interquartile_mean,
    interval,
    percentiles,
    performance_profile,
    probability_of_improvement,
    resampled,
)

few_scores = st.lists(st.floats(-1, 1), min_size=1, max_size=7).map(np.array)


@given(few_scores)
def test_best_of_n_is_the_mean_over_all_choices_of_n(scores):
    found = best_of(scores)
    for n in range(1, len(scores) + 1):
        expected = np.mean([max(chosen) for chosen in combinations(scores, n)])
        assert found[n - 1] == pytest.approx(expected, abs=1e-12)


def test_best_of_n_of_many_and_batched():
    scores = np.random.default_rng(0).normal(size=(3, 128))
    found = best_of(scores)
    np.testing.assert_allclose(found[:, 0], scores.mean(1))
    np.testing.assert_allclose(found[:, -1], scores.max(1))
    assert (np.diff(found, axis=1) >= 0).all()


def test_probability_of_improvement():
    ours, theirs = np.array([[1.0, 3.0], [0.0, 0.0]]), np.array([[2.0, 2.0], [0.0, 1.0]])
    # First configuration: 0 0 1 1; second: ties 1/2, losses 0.
    assert probability_of_improvement(ours, theirs) == pytest.approx((2 + 2 * 0.5) / 8)
    assert probability_of_improvement(ours, theirs) + probability_of_improvement(theirs, ours) == 1
    single = np.random.default_rng(0).normal(size=(2, 1, 9))
    by_scipy = stats.mannwhitneyu(single[0, 0], single[1, 0]).statistic / 81
    assert probability_of_improvement(*single) == pytest.approx(by_scipy)


def test_performance_profile():
    scores = np.array([[0.0, 0.5], [1.0, 1.0]])
    np.testing.assert_allclose(
        performance_profile(scores, np.array([-1, 0, 0.5, 0.7, 1])), [1, 0.75, 0.5, 0.5, 0]
    )


def test_interquartile_mean():
    assert interquartile_mean(np.array([-100.0, 1, 2, 100])) == 1.5


def test_resampling_configurations_then_seeds():
    scores = np.arange(12.0).reshape(4, 3)
    again = resampled(scores, np.random.default_rng(0), 4_000)
    assert again.shape == (4_000, 4, 3)
    owner = again // 3
    assert (owner == owner[..., :1]).all()  # a drawn configuration brings its own seeds
    # Variance of the mean: of the configurations' means over 4, and of seeds within over 12.
    expected = scores.mean(1).var() / 4 + scores.var(1).mean() / 12
    assert again.mean((1, 2)).var() == pytest.approx(expected, rel=0.1)
    kept = resampled(scores, np.random.default_rng(0), 100, configurations=False)
    assert (kept // 3 == np.arange(4)[:, None]).all()


def test_bands_cover_what_they_should():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(200):
        scores = rng.normal(size=(20, 1)) + rng.normal(scale=0.5, size=(20, 3))
        low, high = percentiles(resampled(scores, rng, 300).mean((1, 2)))
        covered += low <= 0 <= high
    assert 0.88 <= covered / 200 <= 0.99


def test_an_interval_over_seeds():
    assert interval(np.array([0.3])) == (0.3, 0.3)
    assert interval(np.array([0.3, 0.3])) == (0.3, 0.3)
    low, high = interval(np.array([0.0, 1.0, 2.0, 3.0]))
    assert 0 <= low < 1.5 < high <= 3
    assert (low, high) == interval(np.array([0.0, 1.0, 2.0, 3.0]))
