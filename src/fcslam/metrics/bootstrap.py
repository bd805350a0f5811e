"""Confidence intervals by bootstrap."""

from typing import NamedTuple

import numpy as np

from fcslam.records import FloatArray

DRAWS = 2000
"""Bootstrap samples of a mean."""


class Interval(NamedTuple):
    """A mean, or another measure, with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float


def mean_interval(values: FloatArray, rng: np.random.Generator) -> Interval:
    """Percentile bootstrap (Efron 1979) of the mean of ``values`` (N,), ignoring NaN.

    For two systems on the same samples, pass their differences to get the paired interval.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return Interval(np.nan, np.nan, np.nan)
    means = known[rng.integers(len(known), size=(DRAWS, len(known)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Interval(float(known.mean()), float(low), float(high))
