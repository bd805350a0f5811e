"""The files of a finished training run: the detector as an ONNX file, its model card, its training curve."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from fcslam.config import Settings, dump
from fcslam.errors import TrainingError, writing
from fcslam.learning.export import detector_version, export_onnx
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages
from fcslam.learning.trainer import PROGRESS_FILE

SHOWN_METRICS = {
    "repeatability": "keypoints found again within 3 px",
    "mma_3px": "matches within 3 px, by bits",
    "shift_repeatability": "keypoints found again within 1 px after a shift by 1 to 7 px",
    "bit_bias": "distance of a bit's mean from a half",
    "code_spread_bits": "bits between codes of different points",
}
LOSSES: Final = ("detector", "contrastive", "triplet", "distillation")
SHARES: Final = ("repeatability", "mma_3px", "shift_repeatability")
BITS: Final = ("code_spread_bits",)

Curves = dict[str, tuple[list[int], list[float]]]
"""Steps and values by name."""


def write_training_artifacts(
    network: KeypointNetwork, folder: Path, settings: TrainingSettings, images: TrainingImages, teacher: Path | None
) -> list[Path]:
    """Write `detector.onnx`, `training.png` and `card.md`; returns their paths."""
    detector, picture, card = (folder / name for name in ("detector.onnx", "training.png", "card.md"))
    export_onnx(network, detector)
    curves = read_curves(folder / "joint" / PROGRESS_FILE, "joint")
    latest = {text: curves[name][1][-1] for name, text in SHOWN_METRICS.items() if name in curves}
    held_out = f"{len(images.held_out)} others were held out" if images.are_held_out else "none was held out"
    facts = [
        f"Trained on {len(images.train)} images; {held_out}, {images.skipped} left out.",
        f"Teacher: {'none' if teacher is None else f'keypoints and descriptors in {teacher.name}'}.",
    ]
    judged = "held-out images" if images.are_held_out else "an image that was trained on"
    judged_on = f"on pairs of views of {judged}, 320 x 240, warped and lit at random"
    with writing(folder):
        draw_curves(curves, picture)
        card.write_text(model_card(detector_version(network), facts, judged_on, latest, settings), encoding="utf-8")
    return [detector, picture, card]


def model_card(
    version: str, facts: Sequence[str], judged_on: str, figures: Mapping[str, float], settings: Settings
) -> str:
    """A model card in Markdown: facts about the training, figures by what they measure, and the settings."""
    lines = [
        f"# Detector {version}",
        "",
        *facts,
        "",
        f"| {judged_on} | |",
        "|---|---|",
        *(f"| {measure} | {value:.3f} |" for measure, value in figures.items()),
        "",
        "Settings:",
        "",
        *(f"    {line}" for line in dump(settings).splitlines()),
    ]
    return "\n".join(lines) + "\n"


def read_curves(path: Path, stage: str) -> Curves:
    """Curves of a stage from its log; of a step that was repeated, the later values count."""
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
