"""The training curve: losses and metrics over the steps, from the log of a run."""

import csv
from pathlib import Path
from typing import Final

from fcslam.errors import TrainingError

LOSSES: Final = ("detector", "contrastive", "triplet", "distillation")
SHARES: Final = ("repeatability", "mma_3px", "shift_repeatability")
BITS: Final = ("code_spread_bits",)

Curves = dict[str, tuple[list[int], list[float]]]
"""Steps and values by name."""


def read_curves(path: Path, stage: str) -> Curves:
    """Curves of a stage from its log; of a step that was repeated, the later values count.

    Raises:
        TrainingError: the file is not a log of a training run.
    """
    values: dict[str, dict[int, float]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if row["stage"] == stage:
                    values.setdefault(row["name"], {})[int(row["step"])] = float(row["value"])
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise TrainingError(f"{path}: is not a log of a training run ({error})") from error
    return {name: (sorted(points), [points[step] for step in sorted(points)]) for name, points in values.items()}


def draw_curves(curves: Curves, path: Path) -> None:
    """Draw three panels: losses, metrics on held-out images, and the distance between codes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    titles = ("losses", "on held-out images", "bits between codes of different points")
    for panel, names, title in zip(panels, (LOSSES, SHARES, BITS), titles, strict=True):
        for name in names:
            if name in curves:
                panel.plot(*curves[name], label=name.replace("_", " "))
        panel.set_title(title)
        panel.set_xlabel("step")
        panel.grid(alpha=0.3)
        if panel.lines:
            panel.legend(frameon=False)
    panels[1].set_ylim(0.0, 1.0)
    figure.savefig(path, dpi=120)
