"""How far a mean over few samples can be trusted."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

DRAWS = 2000
FEW_DRAWS = 300
"""For what takes longer than a mean."""


class Interval(NamedTuple):
    """A mean and where it would lie in 95 of 100 samples of the same size."""

    mean: float
    low: float
    high: float


def mean_interval(values: FloatArray, rng: np.random.Generator) -> Interval:
    """Percentile bootstrap (Efron 1979) of the mean of ``values`` (N,), those that are NaN left out.

    Of two systems on the same samples, the interval of the mean difference is the paired one.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return Interval(np.nan, np.nan, np.nan)
    means = known[rng.integers(len(known), size=(DRAWS, len(known)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Interval(float(known.mean()), float(low), float(high))


def measure_interval(measure: Callable[[NDArray[np.int64]], float], count: int, rng: np.random.Generator) -> Interval:
    """The same for any measure of some of ``count`` samples, which is given their numbers; the first value is of all.

    Draws for which the measure is NaN are left out.
    """
    whole = measure(np.arange(count))
    drawn = np.array([measure(rng.integers(count, size=count)) for _ in range(FEW_DRAWS if count else 0)])
    known = drawn[np.isfinite(drawn)]
    if not len(known):
        return Interval(whole, np.nan, np.nan)
    low, high = np.quantile(known, (0.025, 0.975))
    return Interval(whole, float(low), float(high))
