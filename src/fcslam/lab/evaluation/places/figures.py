"""Precision-recall curves of all scorers, one panel for each question of each set."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from fcslam.errors import writing
from fcslam.lab.evaluation.places.report import SetResult

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
        OutputError: the file cannot be written.
    """
    with writing(path, "choose another place"):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=120, metadata={"Software": None})
