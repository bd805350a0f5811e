"""Place recognition metrics of all scorers, before and after geometric verification."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import writing
from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.records import FloatArray

from .place_features import DescribedSet, PairVerifier, Scorer
from .place_sets import PlaceSet
from .retrieval import (
    PairTruth,
    PrecisionRecall,
    RetrievedPlaces,
    mismatches,
    multi_match_curve,
    recall_at,
    relative_significance,
    significance,
    single_best,
)

RANKS: Final = (1, 5, 10)
DRAWS: Final = 300
"""Bootstrap samples of a measure that is no mean."""
QUERY_BLOCK: Final = 10
"""Consecutive queries that a comparison of two networks draws together."""

COLOURS: Final = (
    "#000000",
    "#7f7f7f",
    "#d95f02",
    "#7570b3",
    "#1b9e77",
    "#e7298a",
    "#66a61e",
    "#a6761d",
    "#1f77b4",
    "#d62728",
    "#17becf",
    "#e6ab02",
    "#8c564b",
    "#9edae5",
    "#ff9896",
    "#98df8a",
    "#c5b0d5",
    "#c49c94",
    "#f7b6d2",
    "#dbdb8d",
)


@dataclass(frozen=True, slots=True)
class Score:
    """Metrics of one scorer on one question of a set."""

    place_set: str
    question: str
    scorer: str
    is_verified: bool
    queries: int
    """Queries that have a match."""
    measures: Mapping[str, Interval]
    """By name, with 95 % intervals by bootstrap over queries: ``recall_at_<k>``, ``average_precision`` and
    ``recall_at_full_precision`` of the single best matches, ``average_precision_multi`` (no interval),
    ``mismatch_rate``, ``significance``, ``relative_significance``."""
    curve: PrecisionRecall
    """Curve of the single best matches."""


@dataclass(frozen=True, slots=True)
class SetResult:
    """Results of all scorers on one set."""

    place_set: PlaceSet
    similarities: Mapping[str, FloatArray]
    """Similarities by scorer, shape (Q, G), before geometric verification."""
    verified: Mapping[str, FloatArray]
    """Similarities by scorer, shape (Q, G), after geometric verification; empty without it."""
    scores: tuple[Score, ...]


def evaluate_set(
    described: DescribedSet,
    scorers: Mapping[str, Scorer],
    checker: PairVerifier | None,
    seed: int,
    watch: Callable[[], None] = lambda: None,
) -> SetResult:
    """Evaluate every scorer on every question of a set.

    ``checker`` verifies by geometry; None: nothing does. ``seed`` is that of the bootstrap; ``watch`` is called after
    each scorer.
    """
    similarities: dict[str, FloatArray] = {}
    verified: dict[str, FloatArray] = {}
    scores: list[Score] = []
    for name, scorer in scorers.items():
        similarity = similarities[name] = scorer(described)
        stages = [(similarity, False)]
        if checker is not None:
            verified[name] = checker.verified(similarity)
            stages.append((verified[name], True))
        scores += _scores(described.place_set, name, stages, seed)
        watch()
    return SetResult(described.place_set, similarities, verified, tuple(scores))


def _scores(place_set: PlaceSet, name: str, stages: Sequence[tuple[FloatArray, bool]], seed: int) -> Iterator[Score]:
    """Scores of every question, before and after geometric verification."""
    for question, truth in place_set.questions.items():
        for similarity, is_verified in stages:
            measures, retrieved = measure(similarity, truth, np.random.default_rng(seed))
            asked = int(truth.answerable.sum())
            yield Score(place_set.name, question, name, is_verified, asked, measures, retrieved.curve())


def measure(
    similarity: FloatArray, truth: PairTruth, rng: np.random.Generator
) -> tuple[dict[str, Interval], RetrievedPlaces]:
    """All measures of a similarity matrix (Q, G) under the names of ``Score``, and the single best matches."""
    retrieved = single_best(similarity, truth)
    count = len(similarity)
    per_query = {
        **{f"recall_at_{k}": recall_at(similarity, truth, k) for k in RANKS},
        "mismatch_rate": mismatches(similarity, truth),
        "significance": significance(similarity, truth),
        "relative_significance": relative_significance(similarity, truth),
    }
    measures = {name: mean_interval(values, rng) for name, values in per_query.items()}
    measures["average_precision"] = measure_interval(lambda rows: retrieved.curve(rows).average_precision, count, rng)
    measures["recall_at_full_precision"] = measure_interval(
        lambda rows: retrieved.curve(rows).recall_at_full_precision, count, rng
    )
    multi = multi_match_curve(similarity, truth).average_precision
    measures["average_precision_multi"] = Interval(multi, np.nan, np.nan)
    return measures, retrieved


def differences(
    similarity: FloatArray, other: FloatArray, truth: PairTruth, rng: np.random.Generator
) -> dict[str, Interval]:
    """Measures of similarities (Q, G) less those of others, of the single best matches, by the names of ``Score``.

    The intervals are paired, over blocks of consecutive queries: images of one drive that follow each other are alike.
    """
    first, second = single_best(similarity, truth), single_best(other, truth)
    gain = np.where(truth.answerable, first.right - second.right, np.nan)
    of: dict[str, Callable[[NDArray[np.int64]], float]] = {
        "recall_at_1": lambda rows: float(np.nanmean(gain[rows])),
        "average_precision": lambda rows: first.curve(rows).average_precision - second.curve(rows).average_precision,
        "recall_at_full_precision": lambda rows: (
            first.curve(rows).recall_at_full_precision - second.curve(rows).recall_at_full_precision
        ),
    }
    return {name: measure_interval(value, len(similarity), rng, QUERY_BLOCK) for name, value in of.items()}


def measure_interval(
    measure: Callable[[NDArray[np.int64]], float], count: int, rng: np.random.Generator, block: int = 1
) -> Interval:
    """Any measure of ``count`` samples, and its interval by percentile bootstrap.

    ``measure`` is given the indices (N,) of samples; draws with NaN are ignored. ``block`` consecutive samples are
    drawn together.
    """
    whole = measure(np.arange(count))

    def draw() -> NDArray[np.int64]:
        starts = rng.integers(count, size=-(-count // block))
        return ((starts[:, None] + np.arange(block)) % count).ravel()[:count]

    drawn = np.array([measure(draw()) for _ in range(DRAWS if count else 0)])
    known = drawn[np.isfinite(drawn)]
    if not len(known):
        return Interval(whole, np.nan, np.nan)
    low, high = np.quantile(known, (0.025, 0.975))
    return Interval(whole, float(low), float(high))


def curves_figure(results: Sequence[SetResult]) -> Any:
    """Draw the curves of the single best matches: solid before geometric verification, dashed after it."""
    panels = [(result, question) for result in results for question in result.place_set.questions]
    figure, axes = panel_figure(len(panels), 3, (4.6, 3.8))
    for axis, (result, question) in zip(axes, panels, strict=True):
        names = list(result.similarities)
        for score in (score for score in result.scores if score.question == question and len(score.curve.recall)):
            curve = score.curve
            axis.plot(
                np.concatenate(([0.0], curve.recall)),
                np.concatenate((curve.precision[:1], curve.precision)),
                color=COLOURS[names.index(score.scorer) % len(COLOURS)],
                linestyle="--" if score.is_verified else "-",
                linewidth=1.2,
                label=None if score.is_verified else score.scorer,
            )
        title = f"{result.place_set.name}, {question}"
        axis.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02), title=title)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, loc="lower left")
    return figure


def panel_figure(panels: int, most_columns: int, size_in: tuple[float, float]) -> tuple[Any, list[Any]]:
    """A figure without a window, with panels of the given size in inches, row by row."""
    from matplotlib.figure import Figure

    columns = min(most_columns, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(columns * size_in[0], rows * size_in[1]), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for empty in axes[panels:]:
        empty.remove()
    return figure, axes[:panels]


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG.

    Raises:
        InputError: the file cannot be written.
    """
    with writing(path, "choose another place"):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=120, metadata={"Software": None})
