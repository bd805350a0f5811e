"""The files of a finished training run: the detector as an ONNX file, its model card, its training curve."""

from pathlib import Path

from fcslam.config import dump
from fcslam.errors import OutputError
from fcslam.learning.curve import draw_curves, read_curves
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


def write_training_artifacts(
    network: KeypointNetwork, folder: Path, settings: TrainingSettings, images: TrainingImages, teacher: Path | None
) -> list[Path]:
    """Write `detector.onnx`, `training.png` and `card.md`; returns their paths.

    Raises:
        OutputError: a file cannot be written.
    """
    detector, picture, card = (folder / name for name in ("detector.onnx", "training.png", "card.md"))
    export_onnx(network, detector)
    curves = read_curves(folder / "joint" / PROGRESS_FILE, "joint")
    try:
        draw_curves(curves, picture)
        latest = {name: curves[name][1][-1] for name in SHOWN_METRICS if name in curves}
        card.write_text(_card(detector_version(network), settings, images, teacher, latest), encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written ({error}); free disk space and run the command again"
        ) from error
    return [detector, picture, card]


def _card(
    version: str, settings: TrainingSettings, images: TrainingImages, teacher: Path | None, figures: dict[str, float]
) -> str:
    taught = "none" if teacher is None else f"keypoints and descriptors in {teacher.name}"
    held_out = f"{len(images.held_out)} others were held out" if images.are_held_out else "none was held out"
    judged = "held-out images" if images.are_held_out else "an image that was trained on"
    lines = [
        f"# Detector {version}",
        "",
        f"Trained on {len(images.train)} images; {held_out}, {images.skipped} left out.",
        f"Teacher: {taught}.",
        "",
        f"| on pairs of views of {judged}, 320 x 240, warped and lit at random | |",
        "|---|---|",
        *(f"| {SHOWN_METRICS[name]} | {value:.3f} |" for name, value in figures.items()),
        "",
        "Settings:",
        "",
        *(f"    {line}" for line in dump(settings).splitlines()),
    ]
    return "\n".join(lines) + "\n"
