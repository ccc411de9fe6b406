"""Interquartile means over runs, and their bootstrap intervals."""

from __future__ import annotations

import numpy as np

_RESAMPLES = 10_000


def interquartile_mean(scores: np.ndarray) -> tuple[float, float, float]:
    """Compute the interquartile mean of scores, and its 95 % stratified bootstrap interval.

    Scores are (R,) of at least 2 runs, or (S, R) of the runs in each of S strata, such as tasks.
    The mean is that of the middle half of all scores, without a quarter, rounded down, at each end.
    Each resample draws R runs of each stratum with replacement. Recommended for few runs by
    Agarwal et al., arXiv 2108.13264.
    """
    from scipy import stats

    strata = np.asarray(scores, np.float64)
    strata = strata[None] if strata.ndim == 1 else strata
    if strata.ndim != 2 or strata.shape[1] < 2 or not len(strata):
        raise ValueError(
            f"scores must be those of at least 2 runs, (R,) or (strata, R), got shape "
            f"{np.shape(scores)}."
        )
    random = np.random.default_rng(0)
    drawn = [random.choice(runs, (_RESAMPLES, len(runs))) for runs in strata]
    means = stats.trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(stats.trim_mean(strata, 0.25, axis=None)), float(low), float(high)
