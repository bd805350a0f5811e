"""The figure and the table of a growing vocabulary."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fcslam.lab.evaluation.places.figures import COLOURS, panel_figure
from fcslam.lab.evaluation.places.vocabulary_growth import BATCH, MEASURES, Growth
from fcslam.records import FloatArray

_TITLES = {
    "significance": "(a) significance of the true match",
    "mismatch rate": "(b) mismatch rate",
    "wrong places, mean": "(c) similarity of wrong places, mean",
    "wrong places, variance": "(c) similarity of wrong places, variance",
    "words": "(d) words",
    "relative significance": "relative significance",
    "seconds": f"seconds to take in {BATCH} places",
}
_LOGARITHMIC = ("words", "seconds")


def draw_growth(growths: Mapping[str, Growth], caption: str, seed: int) -> Any:
    """Draw figure 4 of FC-SLAM with 95 % bootstrap bands over the groups; ``caption`` describes the data."""
    figure, axes = panel_figure(len(_TITLES), 4, (4.4, 3.6))
    for axis, (measure, title) in zip(axes, _TITLES.items(), strict=True):
        for colour, (name, growth) in zip(COLOURS, growths.items(), strict=False):
            values = _series(growth, measure, seed)
            if np.isfinite(values[:, 0]).any():
                axis.plot(growth.places, values[:, 0], color=colour, linewidth=1.2, label=name)
                axis.fill_between(growth.places, values[:, 1], values[:, 2], color=colour, alpha=0.15, linewidth=0)
        axis.set(xlabel="places", title=title, yscale="log" if measure in _LOGARITHMIC else "linear")
        axis.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="lower right", bbox_to_anchor=(0.94, 0.2))
    figure.supxlabel(caption, fontsize=9)
    return figure


def _series(growth: Growth, measure: str, seed: int) -> FloatArray:
    """Mean, lower and upper bound after every batch, shape (U, 3)."""
    if measure in MEASURES:
        return np.array([growth.intervals(update, seed)[measure] for update in range(len(growth.places))])
    values = growth.words if measure == "words" else growth.seconds
    return np.repeat(values[:, None], 3, axis=1)
