"""Compares a version of the detector with the best one so far, by every evaluator that measured both."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fcslam.learning.federated.held_out import COLUMNS, Judgement, same_pairs
from fcslam.learning.federated.weights import Weights
from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.records import FloatArray

MOST_PLACES_LOST: Final = 0.05
"""Largest loss of places found again that the lower end of the interval of a released version may allow, as a share."""
SCORE_METRICS: Final = ("repeatability", "mma_3px")
LOWEST_SCORE: Final = -1.0
"""Score of a version with an unknown metric: lower than that of any version whose metrics are known."""

Metrics = Mapping[str, float]
"""Values by name; those in ``SCORE_METRICS`` are shares in [0, 1]."""
EvaluateFn = Callable[[Weights], Metrics]
"""Evaluation by the coordinator itself, on public images; Flower's ``evaluate_fn``."""
PUBLIC_IMAGES: Final = ""
"""Stands for the coordinator among the evaluators of a version, which are named; no robot's name is empty."""


@dataclass(frozen=True, slots=True)
class GateDecision:
    """Whether a version is released, and why."""

    released: bool
    reason: str
    pairs: int
    """On which both versions were judged."""
    gains: Mapping[str, Interval]
    """Mean differences to the released version with 95 % intervals, by column."""
    values: Mapping[str, float]
    """Means of the version itself, by column."""


def decide(
    candidate: Mapping[str, Judgement], released: Mapping[str, Judgement], fewest_pairs: int, seed: int
) -> GateDecision:
    """The release gate of a fleet that learns while it maps: compare a version with the released one.

    It has to be better on pairs that no robot trained on, and to find places as well. Both comparisons are paired:
    every pair is judged with both versions, and the intervals are those of the differences. Both mappings hold what
    each robot reports, on the same pairs; ``seed`` is that of the bootstrap.
    """
    differences = same_pairs(candidate, released)
    rows = np.concatenate([*differences.values(), np.empty((0, len(COLUMNS)))])
    rng = np.random.default_rng(seed)
    gains = {name: mean_interval(column, rng) for name, column in zip(COLUMNS, rows.T, strict=True)}
    known = [candidate[robot].astype(np.float64) for robot in differences]
    values = {
        name: float(np.nanmean(column)) if np.isfinite(column).any() else np.nan
        for name, column in zip(COLUMNS, np.concatenate([*known, np.empty((0, len(COLUMNS)))]).T, strict=True)
    }
    reason = _objection(
        rows, [float(np.mean(each[:, 0])) for each in differences.values() if len(each)], gains, fewest_pairs
    )
    return GateDecision(reason is None, reason or "better on held-out pairs", len(rows), gains, values)


def _objection(rows: FloatArray, by_robot: list[float], gains: Mapping[str, Interval], fewest_pairs: int) -> str | None:
    """Why a version is not released; None if it is."""
    recall, found = (gains[name] for name in COLUMNS)
    if len(rows) < fewest_pairs:
        return f"{len(rows)} held-out pairs, {fewest_pairs} needed"
    if not recall.low > 0.0:
        return f"not better on held-out pairs: {_shown(recall)}"
    if float(np.median(by_robot)) < 0.0:  # the reports of a few robots do not decide for the others
        return "not better for most robots"
    if not np.isfinite(found.mean):
        return "no robot knows two different places to compare"
    if not found.low >= -MOST_PLACES_LOST:
        return f"may find fewer places: {_shown(found)}"
    return None


def _shown(interval: Interval) -> str:
    return f"{interval.mean:+.3f} [{interval.low:+.3f}; {interval.high:+.3f}]"


def combined_score(metrics: Metrics) -> float:
    """The score by which versions are compared: the mean of repeatability and MMA, in [0, 1]."""
    values = [metrics.get(name, np.nan) for name in SCORE_METRICS]
    return float(np.mean(values)) if np.isfinite(values).all() else LOWEST_SCORE


def valid_metrics(metrics: Metrics) -> dict[str, float]:
    """The metrics of a robot's evaluation that count: both shares, or none if one is missing or outside [0, 1]."""
    found = {name: metrics[name] for name in SCORE_METRICS if 0.0 <= metrics.get(name, np.nan) <= 1.0}
    return found if len(found) == len(SCORE_METRICS) else {}


@dataclass(frozen=True, slots=True)
class VersionComparison:
    """A version beside the best one so far."""

    by_evaluator: Mapping[str, Metrics]
    """Metrics of the version; empty if it was not evaluated in this round."""
    best: Mapping[str, float]
    """Scores of the best version, by everyone who ever evaluated it."""
    gate: GateDecision | None = None
    """The decision of the gate on pairs that robots hold out, if there is one; then nothing else was evaluated."""

    @property
    def scores(self) -> dict[str, float]:
        """Scores of the version by evaluator."""
        return {evaluator: combined_score(metrics) for evaluator, metrics in self.by_evaluator.items()}

    @property
    def score(self) -> float:
        """Median of the scores, or the share of shared keypoints that match; NaN if the version was not evaluated."""
        if self.gate is not None:
            return self.gate.values[COLUMNS[0]]
        return float(np.median(list(self.scores.values()))) if self.by_evaluator else math.nan

    @property
    def metrics(self) -> dict[str, float]:
        """Median of each metric over the evaluators, or means over held-out pairs with the gains of the version."""
        if self.gate is not None:
            gains = {f"{name}_gain": gain.mean for name, gain in self.gate.gains.items()}
            return {**self.gate.values, **gains, "pairs": float(self.gate.pairs)}
        rows = self.by_evaluator.values()
        names = dict.fromkeys(name for row in rows for name in row)
        return {name: float(np.median([row[name] for row in rows if name in row])) for name in names}

    @property
    def gain(self) -> float | None:
        """Gain over the best version: median over the evaluators of both versions; None if no evaluator has both.

        Robots hold out different images, so their scores differ in level. Only differences at the same robot are
        compared: robots that join or leave do not change the gain. The median ignores a minority of false scores.
        """
        if self.gate is not None:
            gain = self.gate.gains[COLUMNS[0]].mean
            return gain if math.isfinite(gain) else None
        scores = self.scores
        gains = [score - self.best[evaluator] for evaluator, score in scores.items() if evaluator in self.best]
        return float(np.median(gains)) if gains else None
