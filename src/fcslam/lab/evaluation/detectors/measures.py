"""The measures of ``homography`` by name, for each pair and as means over pairs."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fcslam.errors import writing
from fcslam.lab.evaluation.detectors.homography import ACCURACY_PX, HomographyReport, MatchingResult, PairResult
from fcslam.lab.evaluation.detectors.scenes import SceneKind
from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.records import FloatArray

CORRECT_CORNERS_PX = (1, 2, 3, 5)
"""Thresholds of the corner error of a correct homography."""


def pair_measures(pair: PairResult) -> dict[str, float]:
    """All measures of a pair: ``repeatability``, ``localization_error_px``, and for each NMS n in pixels
    ``homography_<e>px_nms<n>`` (0 or 1), ``accuracy_<t>px_nms<n>``, ``score_nms<n>``, ``matches_nms<n>`` and
    ``corner_error_px_nms<n>``."""
    measures = {
        "repeatability": pair.repeatability.repeatability,
        "localization_error_px": pair.repeatability.localization_error_px,
    }
    for nms_px, result in pair.matching.items():
        measures |= {f"{name}_nms{nms_px}": value for name, value in _matching_measures(result).items()}
    return measures


def column(pairs: Sequence[PairResult], measure: str) -> FloatArray:
    """One measure of every pair, shape (N,); NaN if unknown."""
    return np.array([pair_measures(pair).get(measure, np.nan) for pair in pairs], np.float64)


def mean(pairs: Sequence[PairResult], measure: str, kind: SceneKind | None = None) -> float:
    """Mean of a measure over the pairs, or over those of one kind of scene; NaN without any."""
    values = column([pair for pair in pairs if kind in (None, pair.kind)], measure)
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def interval(pairs: Sequence[PairResult], measure: str, seed: int) -> Interval:
    """The mean over all pairs with its bootstrap interval."""
    return mean_interval(column(pairs, measure), np.random.default_rng(seed))


def difference(first: Sequence[PairResult], other: Sequence[PairResult], measure: str, seed: int) -> Interval:
    """Mean difference ``first`` minus ``other`` on the same pairs, with its paired bootstrap interval."""
    return mean_interval(column(first, measure) - column(other, measure), np.random.default_rng(seed))


def write_pairs(report: HomographyReport, path: Path) -> None:
    """Write a CSV file with a line for every detector and pair, and a column for every measure.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = [(pair, pair_measures(pair)) for pair in report.pairs]
    names = list(dict.fromkeys(name for _, measures in rows for name in measures))
    with writing(path, "choose another place"), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["detector", "scene", "kind", "image", *names])
        for pair, measures in rows:
            cells = (f"{measures[name]:.6g}" if name in measures else "" for name in names)
            writer.writerow([pair.detector, pair.scene, pair.kind, pair.image, *cells])


def _matching_measures(result: MatchingResult) -> dict[str, float]:
    return {
        **{f"homography_{px}px": float(result.corner_error_px <= px) for px in CORRECT_CORNERS_PX},
        **{f"accuracy_{px}px": float(share) for px, share in zip(ACCURACY_PX, result.accuracy, strict=True)},
        "score": result.score,
        "matches": float(result.matches),
        "corner_error_px": result.corner_error_px,
    }
