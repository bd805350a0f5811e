"""The report of a study of federated training: gaps to central training with intervals, and the worst robot."""

from dataclasses import dataclass

import numpy as np

from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.records import FloatArray

from .pairs import MEASURES
from .study import ALONE, CENTRAL, LOCAL, StudyResults


@dataclass(frozen=True, slots=True)
class ArmReport:
    """One arm by one measure."""

    arm: str
    measure: str
    mean: float
    gap: Interval
    """The reference arm, central by default, minus this arm: the paired bootstrap interval over the same pairs and
    seeds, averaged over the seeds first."""
    closed: float
    """(arm - local) / (central - local); NaN if central is not significantly better than local, or local is unknown."""
    closed_alone: float
    """The same with the arm ``ALONE`` in place of ``LOCAL``."""
    worst_robot: str
    worst_gap: float
    """The gap on that robot's pairs."""
    seeds: tuple[float, ...]
    """The mean of each seed."""


def report(results: StudyResults, seed: int = 1, against: str = CENTRAL) -> list[ArmReport]:
    """Report every arm by every measure.

    Args:
        results: of the study.
        seed: of the bootstrap.
        against: the reference arm, which has at least as many seeds as any other.
    """
    return [
        _report(results, arm, index, against, np.random.default_rng(seed))
        for index in range(len(MEASURES))
        for arm in results.measured
    ]


def _report(results: StudyResults, arm: str, index: int, against: str, rng: np.random.Generator) -> ArmReport:
    seeds = len(results.measured[arm])
    values, reference, central = (_by_pair(results.measured[name][:seeds], index) for name in (arm, against, CENTRAL))
    gap = mean_interval(reference - values, rng)
    closed, closed_alone = (
        _closed(values, _by_pair(results.measured[own][:seeds], index), central, rng)
        if own in results.measured
        else np.nan
        for own in (LOCAL, ALONE)
    )
    owners = np.array(results.owners)
    gaps = [float(np.nanmean((reference - values)[owners == robot])) for robot in range(len(results.robots))]
    worst = int(np.argmax(gaps))
    return ArmReport(
        arm=arm,
        measure=MEASURES[index],
        mean=float(np.nanmean(values)),
        gap=gap,
        closed=closed,
        closed_alone=closed_alone,
        worst_robot=results.robots[worst],
        worst_gap=gaps[worst],
        seeds=tuple(float(np.nanmean(each[..., index])) for each in results.measured[arm]),
    )


def _closed(values: FloatArray, low: FloatArray, high: FloatArray, rng: np.random.Generator) -> float:
    gain = mean_interval(high - low, rng)
    return float(np.nanmean(values - low)) / gain.mean if gain.low > 0.0 else np.nan


def _by_pair(measured: FloatArray, index: int) -> FloatArray:
    """One measure of every pair, mean over seeds and networks, shape (pairs,); NaN where it is unknown."""
    values = measured[..., index]
    known = np.isfinite(values)
    counts = known.sum(axis=(0, 1))
    sums = np.where(known, values, 0.0).sum(axis=(0, 1))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
