"""Figures of correct and wrong matches, and curves of matching accuracy."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fcslam.errors import OutputError
from fcslam.lab.evaluation.detectors.evaluated_detectors import EvaluatedDetector, frame
from fcslam.lab.evaluation.detectors.homography import (
    ACCURACY_PX,
    LARGE,
    MATCHED,
    MATCHING_NMS_PX,
    HomographyReport,
    described,
    matched_points,
    thinned,
)
from fcslam.lab.evaluation.detectors.measures import mean
from fcslam.lab.evaluation.detectors.scenes import Scene
from fcslam.metrics.framing import HomographyGroundTruth, framed_homography
from fcslam.metrics.homography import match_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RIGHT_PX = 3.0
_RIGHT, _WRONG = "#1a9850", "#d73027"


def draw_figures(
    folder: Path,
    report: HomographyReport,
    scenes: Sequence[Scene],
    detectors: Sequence[EvaluatedDetector],
    truth: HomographyGroundTruth,
    watch: Callable[[], None] = lambda: None,
) -> None:
    """Write ``matching_accuracy.png`` and, for each scene, ``SCENE.png``: matches of its middle pair of images.

    Raises:
        OutputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _draw_accuracy(folder / "matching_accuracy.png", report)
        shown = [each for each in detectors if report.of(each.name)[0].matching]
        for scene in scenes:
            if shown:
                _draw_scene(folder / f"{scene.name}.png", scene, shown, truth)
            watch()
    except OSError as error:
        raise OutputError(f"{folder}: cannot write the figures ({error})") from error


def _draw_accuracy(path: Path, report: HomographyReport) -> None:
    figure, axes = _figure(1, len(MATCHING_NMS_PX), (10.0, 4.0))
    for axis, nms_px in zip(axes.flat, MATCHING_NMS_PX, strict=True):
        for detector in report.detectors:
            pairs = report.of(detector)
            if pairs[0].matching:
                shares = [mean(pairs, f"accuracy_{px}px_nms{nms_px}") for px in ACCURACY_PX]
                axis.plot(ACCURACY_PX, shares, marker=".", label=detector)
        axis.set(xlabel="threshold, px", ylabel="mean matching accuracy", ylim=(0.0, 1.0), title=_nms_title(nms_px))
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend()
    figure.savefig(path, dpi=120)


def _draw_scene(path: Path, scene: Scene, detectors: Sequence[EvaluatedDetector], truth: HomographyGroundTruth) -> None:
    """Draw one row for each detector: image 1 beside the middle one of the other images."""
    other, H = scene.others[len(scene.others) // 2]
    first, second = frame(scene.reference, LARGE), frame(other, LARGE)
    true = framed_homography(H, first.framing, second.framing, truth)
    figure, axes = _figure(len(detectors), 1, (10.0, 4.0 * len(detectors)))
    for axis, detector in zip(axes.flat, detectors, strict=True):
        found = (thinned(described(detector.find(each)), MATCHING_NMS_PX[0]) for each in (first, second))
        here, there = matched_points(*(each.take(slice(MATCHED)) for each in found))
        right = match_errors(here, there, true) <= RIGHT_PX
        axis.imshow(np.hstack((first.grey, second.grey)), cmap="gray", vmin=0, vmax=255)
        _draw_lines(axis, here, there + np.array([LARGE[0], 0]), right)
        axis.set_title(f"{detector.name}, {scene.name} 1-{other.stem}: {right.sum()} of {len(right)} matches right")
        axis.axis("off")
    figure.savefig(path, dpi=120)


def _draw_lines(axis: "Axes", here: Any, there: Any, right: Any) -> None:
    from matplotlib.collections import LineCollection

    segments = np.stack((here, there), axis=1)
    for chosen, colour in ((~right, _WRONG), (right, _RIGHT)):
        axis.add_collection(LineCollection(list(segments[chosen]), colors=colour, linewidths=0.5, alpha=0.6))


def _figure(rows: int, columns: int, size_in: tuple[float, float]) -> tuple[Any, Any]:
    """A figure without a window, and its axes (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_in, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _nms_title(nms_px: int) -> str:
    return f"NMS {nms_px}" if nms_px else "as detected"
