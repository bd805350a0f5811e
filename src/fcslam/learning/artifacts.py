"""The files of a finished training run: the detector as an ONNX file, its model card, and a picture of its curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fcslam.config import Settings, dump
from fcslam.errors import writing
from fcslam.learning.export import detector_version, export_onnx
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import DETECTOR

Curve = tuple[Sequence[float], Sequence[float]]
"""Steps or rounds, and the values there."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel of the picture."""

    title: str
    curves: Mapping[str, Curve]
    """By their labels."""
    are_shares: bool = False
    """The values are in [0, 1]."""
    marks: Sequence[int] = ()
    """Steps or rounds with a grey line."""


@dataclass(frozen=True, slots=True)
class TrainingReport:
    """What a card and a picture show of a run."""

    facts: Sequence[str]
    judged_on: str
    """The images on which the detector was evaluated."""
    figures: Mapping[str, float]
    """By what they measure."""
    panels: Sequence[Panel]
    x_label: str


def write_artifacts(
    network: KeypointNetwork, folder: Path, picture: str, settings: Settings, report: TrainingReport
) -> list[Path]:
    """Write the detector, the picture and the model card; returns their paths."""
    paths = [folder / name for name in (DETECTOR, picture, "card.md")]
    export_onnx(network, paths[0])
    with writing(folder):
        draw_panels(report, paths[1])
        paths[2].write_text(model_card(detector_version(network), report, settings), encoding="utf-8")
    return paths


def model_card(version: str, report: TrainingReport, settings: Settings) -> str:
    """A model card in Markdown: facts about the training, figures by what they measure, and the settings."""
    lines = [
        f"# Detector {version}",
        "",
        *report.facts,
        "",
        f"| {report.judged_on} | |",
        "|---|---|",
        *(f"| {measure} | {value:.3f} |" for measure, value in report.figures.items()),
        "",
        "Settings:",
        "",
        *(f"    {line}" for line in dump(settings).splitlines()),
    ]
    return "\n".join(lines) + "\n"


def draw_panels(report: TrainingReport, path: Path) -> None:
    """Draw the panels side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(report.panels)), report.panels, strict=True):
        for label, curve in panel.curves.items():
            axes.plot(*curve, label=label)
        for mark in panel.marks:
            axes.axvline(mark, color="0.8", linewidth=0.8, zorder=0)
        if panel.are_shares:
            axes.set_ylim(0.0, 1.0)
        axes.set_title(panel.title)
        axes.set_xlabel(report.x_label)
        axes.grid(alpha=0.3)
        if panel.curves:
            axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
