"""Compares a version of the detector with the released one, by every evaluator that measured both."""

import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from fcslam.learning.federated.held_out import COLUMNS, Judgement, same_pairs
from fcslam.learning.federated.rounds import Evaluation
from fcslam.learning.federated.weights import Weights
from fcslam.metrics.bootstrap import Interval, mean_interval

MOST_PLACES_LOST: Final = 0.05
"""Largest loss of places found again that the lower end of the interval of a released version may allow, as a share."""
SCORE_METRICS: Final = ("repeatability", "mma_3px")

Metrics = Mapping[str, float]
"""Values by name; those in ``SCORE_METRICS`` are shares in [0, 1]."""
EvaluateFn = Callable[[Weights], Mapping[str, Metrics]]
"""Metrics of weights by evaluator: one for public images, or each robot by its own held-out images."""
PUBLIC_IMAGES: Final = ""
"""Evaluator by public images; no robot's name is empty."""


def compare(by_evaluator: Mapping[str, Metrics], released: Mapping[str, float]) -> Evaluation:
    """Compare a version's metrics with the scores of the released version; it is released if it is not worse.

    Robots hold out different images, so their scores differ in level: only differences at the same robot are compared.
    """
    if not by_evaluator:
        return Evaluation()
    rows, scores = by_evaluator.values(), {name: combined_score(each) for name, each in by_evaluator.items()}
    names = dict.fromkeys(name for row in rows for name in row)
    metrics = {name: float(np.median([row[name] for row in rows if name in row])) for name in names}
    gains = [score - released[name] for name, score in scores.items() if name in released]
    gain = float(np.median(gains)) if gains else math.nan
    return Evaluation(metrics, float(np.median(list(scores.values()))), gain, gain >= 0.0, scores=scores)


def combined_score(metrics: Metrics) -> float:
    """The score by which versions are compared: the mean of repeatability and MMA, in [0, 1]; -1 if one is unknown."""
    values = [metrics.get(name, np.nan) for name in SCORE_METRICS]
    return float(np.mean(values)) if np.isfinite(values).all() else -1.0


def gate(
    candidate: Mapping[str, Judgement], released: Mapping[str, Judgement], fewest_pairs: int, seed: int
) -> Evaluation:
    """The release gate of a fleet that learns while it maps: compare a version with the released one.

    It has to be better on pairs that no robot trained on, and to find places as well. Both comparisons are paired:
    every pair is judged with both versions, and the intervals are those of the differences. Both mappings hold what
    each robot reports, on the same pairs; ``seed`` is that of the bootstrap.
    """
    differences = same_pairs(candidate, released)
    nothing, rng = np.empty((0, len(COLUMNS))), np.random.default_rng(seed)
    rows = np.concatenate([*differences.values(), nothing])
    recall, found = gains = [mean_interval(column, rng) for column in rows.T]
    values = np.concatenate([*(candidate[robot].astype(np.float64) for robot in differences), nothing])
    metrics = {
        name: float(np.nanmean(column)) if np.isfinite(column).any() else np.nan
        for name, column in zip(COLUMNS, values.T, strict=True)
    }
    metrics |= {f"{name}_gain": gain.mean for name, gain in zip(COLUMNS, gains, strict=True)}
    reason = None
    if len(rows) < fewest_pairs:
        reason = f"{len(rows)} held-out pairs, {fewest_pairs} needed"
    elif not recall.low > 0.0:
        reason = f"not better on held-out pairs: {_shown(recall)}"
    elif np.median([np.mean(each[:, 0]) for each in differences.values() if len(each)]) < 0.0:
        reason = "not better for most robots"  # the reports of a few robots do not decide for the others
    elif not np.isfinite(found.mean):
        reason = "no robot knows two different places to compare"
    elif not found.low >= -MOST_PLACES_LOST:
        reason = f"may find fewer places: {_shown(found)}"
    return Evaluation(
        metrics | {"pairs": float(len(rows))},
        metrics[COLUMNS[0]],
        recall.mean,
        reason is None,
        reason or "better on held-out pairs",
    )


def _shown(interval: Interval) -> str:
    return f"{interval.mean:+.3f} [{interval.low:+.3f}; {interval.high:+.3f}]"
