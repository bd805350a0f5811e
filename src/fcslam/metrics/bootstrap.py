"""Confidence intervals by bootstrap."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

DRAWS = 2000
"""Bootstrap samples of a mean."""
FEW_DRAWS = 300
"""Bootstrap samples of any other measure, which takes longer."""


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


def measure_interval(measure: Callable[[NDArray[np.int64]], float], count: int, rng: np.random.Generator) -> Interval:
    """Percentile bootstrap of any measure of ``count`` samples.

    Args:
        measure: computes the measure of the samples whose indices (N,) it is given; draws with NaN are ignored.
        count: number of samples.
        rng: random generator.

    Returns:
        The measure of all samples and its interval.
    """
    whole = measure(np.arange(count))
    drawn = np.array([measure(rng.integers(count, size=count)) for _ in range(FEW_DRAWS if count else 0)])
    known = drawn[np.isfinite(drawn)]
    if not len(known):
        return Interval(whole, np.nan, np.nan)
    low, high = np.quantile(known, (0.025, 0.975))
    return Interval(whole, float(low), float(high))
