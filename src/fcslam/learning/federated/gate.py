"""The release gate of a fleet that learns while it maps: a version has to be better on pairs that no robot trained on.

It must also find places as well as the released version. Both comparisons are paired: every pair is
judged with both versions, and the intervals are those of the differences.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fcslam.learning.federated.held_out import COLUMNS, Judgement, same_pairs
from fcslam.learning.federated.live_settings import GateSettings
from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.records import FloatArray


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
    candidate: Mapping[str, Judgement], released: Mapping[str, Judgement], settings: GateSettings, seed: int
) -> GateDecision:
    """Compare a version with the released one.

    Args:
        candidate: what each robot reports of the version.
        released: what each reports of the released version, on the same pairs.
        settings: thresholds.
        seed: of the bootstrap.
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
        rows, [float(np.mean(each[:, 0])) for each in differences.values() if len(each)], gains, settings
    )
    return GateDecision(reason is None, reason or "better on held-out pairs", len(rows), gains, values)


def _objection(
    rows: FloatArray, by_robot: list[float], gains: Mapping[str, Interval], settings: GateSettings
) -> str | None:
    """Why a version is not released; None if it is."""
    recall, found = (gains[name] for name in COLUMNS)
    if len(rows) < settings.fewest_pairs:
        return f"{len(rows)} held-out pairs, {settings.fewest_pairs} needed"
    if not recall.low > 0.0:
        return f"not better on held-out pairs: {_shown(recall)}"
    if float(np.median(by_robot)) < 0.0:  # the reports of a few robots do not decide for the others
        return "not better for most robots"
    if not np.isfinite(found.mean):
        return "no robot knows two different places to compare"
    if not found.low >= -settings.margin:
        return f"may find fewer places: {_shown(found)}"
    return None


def _shown(interval: Interval) -> str:
    return f"{interval.mean:+.3f} [{interval.low:+.3f}; {interval.high:+.3f}]"
