"""Which of two versions of the detector is better, by whoever judged both."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

SCORE_METRICS: Final = ("repeatability", "mma_3px")

Metrics = Mapping[str, float]


def combined_score(figures: Metrics) -> float:
    """What versions of the detector are compared by: the mean of repeatability and MMA; -1 where one is not known."""
    values = [figures.get(name, np.nan) for name in SCORE_METRICS]
    return float(np.mean(values)) if np.isfinite(values).all() else -1.0


def valid_metrics(figures: Metrics) -> dict[str, float]:
    """What a robot may say of a version: both shares, or nothing."""
    found = {name: figures[name] for name in SCORE_METRICS if 0.0 <= figures.get(name, np.nan) <= 1.0}
    return found if len(found) == len(SCORE_METRICS) else {}


@dataclass(frozen=True, slots=True)
class VersionComparison:
    """On a version, beside the best one so far."""

    by_evaluator: Mapping[str, Metrics]
    """Figures of the version; none where it is not judged."""
    best: Mapping[str, float]
    """Scores of the best, by all who ever judged it."""

    @property
    def scores(self) -> dict[str, float]:
        """The version's, by who judged it."""
        return {judge: combined_score(figures) for judge, figures in self.by_evaluator.items()}

    @property
    def score(self) -> float:
        """The median; NaN if nobody judged."""
        return float(np.median(list(self.scores.values()))) if self.by_evaluator else math.nan

    @property
    def figures(self) -> dict[str, float]:
        """Medians of each."""
        names = dict.fromkeys(name for figures in self.by_evaluator.values() for name in figures)
        rows = self.by_evaluator.values()
        return {name: float(np.median([row[name] for row in rows if name in row])) for name in names}

    @property
    def gain(self) -> float | None:
        """How much better it is than the best: the median over those who judged both; None if nobody did.

        Robots hold out other images and have other figures: who comes and goes must not make a version better or
        worse. Of several, one that lies does not decide.
        """
        scores = self.scores
        both = sorted(scores.keys() & self.best.keys())
        return float(np.median([scores[judge] - self.best[judge] for judge in both])) if both else None
