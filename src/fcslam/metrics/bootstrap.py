"""How far a mean over few samples can be trusted."""

from typing import NamedTuple

import numpy as np

from fcslam.records import FloatArray

DRAWS = 2000


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
