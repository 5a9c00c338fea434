"""Statistics of many scores: intervals, best of n, profiles, probabilities of improvement.

A ``(configurations, seeds)`` array holds the scores of one interface. Every function that draws takes a generator.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Scores = NDArray[np.float64]
RESAMPLES = 2_000
CONFIDENCE = 0.95


def interquartile_mean(scores: Scores, axis: int = 0) -> Any:
    """The mean of the middle half of the scores."""
    return stats.trim_mean(scores, 0.25, axis=axis)


def interval(
    scores: Scores, statistic: Callable[..., Any] = np.mean, rng: np.random.Generator | None = None
) -> tuple[float, float]:
    """Bootstrap interval of a statistic over seeds ``(seeds,)`` (percentiles); a point for one seed.

    Without ``rng`` it uses a generator of a fixed seed.
    """
    if len(scores) < 2 or np.ptp(scores) == 0:
        return float(scores.mean()), float(scores.mean())
    found = stats.bootstrap(
        (scores,),
        statistic,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0) if rng is None else rng,
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def resampled(
    scores: Scores, rng: np.random.Generator, resamples: int = RESAMPLES, *, configurations: bool = True
) -> Scores:
    """Hierarchical bootstrap: configurations drawn with replacement, then seeds within each.

    Args:
        scores: ``(configurations, seeds)``.
        rng: generator of the draws.
        resamples: number of bootstrap samples.
        configurations: False keeps the configurations as they are and draws seeds only (a stratified bootstrap).

    Returns:
        ``(resamples, configurations, seeds)``.
    """
    many, seeds = scores.shape
    drawn = np.broadcast_to(np.arange(many), (resamples, many))
    if configurations:
        drawn = rng.integers(many, size=(resamples, many))
    return scores[drawn[..., None], rng.integers(seeds, size=(resamples, many, seeds))]


def percentiles(values: Scores) -> Scores:
    """The ends of the interval of statistics ``(resamples, ...)`` of resampled scores: ``(2, ...)``."""
    outside = 50 * (1 - CONFIDENCE)
    return np.percentile(values, [outside, 100 - outside], axis=0)


def performance_profile(scores: Scores, levels: Scores) -> Scores:
    """The share of scores ``(..., configurations, seeds)`` above each level ``(levels,)``: ``(..., levels)``."""
    flat = scores.reshape(*scores.shape[:-2], -1)
    return (flat[..., None, :] > levels[:, None]).mean(-1)


def best_of(scores: Scores) -> Scores:
    """Expected best of n configurations drawn without replacement, n = 1 .. all (Dodge et al. 2019): ``(..., n)``.

    With the scores sorted, the i-th of N is the largest of n with the probability C(i - 1, n - 1) / C(N, n).

    Args:
        scores: of the configurations, ``(..., N)``.
    """
    ranked = np.sort(scores, axis=-1)
    many = ranked.shape[-1]
    weights = np.zeros((many, many))
    for n in range(1, many + 1):
        weight = n / many  # of the largest; each smaller one's follows from the next larger's
        for i in range(many, n - 1, -1):
            weights[n - 1, i - 1] = weight
            weight *= (i - n) / (i - 1) if i > 1 else 0.0
    return ranked @ weights.T


def probability_of_improvement(ours: Scores, theirs: Scores) -> Any:
    """Probability that one of our runs beats one of theirs of the same configuration, ties counting half: ``(...)``.

    Agarwal et al. 2021, with configurations in the place of tasks.

    Args:
        ours: ``(..., configurations, seeds)``.
        theirs: ``(..., configurations, seeds')``.
    """
    difference = ours[..., :, None] - theirs[..., None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean((-3, -2, -1))
