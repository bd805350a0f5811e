"""How far off detectors put the corners of drawn chequerboards, and whether corners of the image would be better.

    FCSLAM_DATA=/path/to/data python benchmarks/corners.py [--weights detector.onnx ...]

Boards of 320 x 240 in 16 sizes and turns, blurred by 1 px. Of the corners with a keypoint within 6 px, the distance of
the nearest one, and by how much more of it lies along the light fields than along the dark ones. Refined: keypoints
moved to corners by OpenCV's cornerSubPix in a window of 11 px. Repeatability and localization error on the pairs of
five scenes, as in `homography.py`, tell what that is worth. Networks look at three scales.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import common
import cv2
import numpy as np
from evaluation.baselines import moved_to_corners
from evaluation.detectors import (
    EvaluatedDetector,
    EvaluatedDetectorKind,
    FramedImage,
    Framing,
    Scene,
    choose_detectors,
    find_scenes,
    frame,
    one_thread,
)
from evaluation.homography import SMALL, HomographyGroundTruth, framed_homography, repeat_pair
from scipy.spatial import KDTree

from fcslam.features.detector import BUNDLED_NETWORK, GreyImage, Keypoints
from fcslam.records import FloatArray, frozen

SCENES = ("oxford_affine", "hpatches_subset")
NETWORKS = (Path("vgg"), BUNDLED_NETWORK)
CORNER_DETECTORS = (EvaluatedDetectorKind.HARRIS, EvaluatedDetectorKind.SHI)
BOARD, FIELDS_PX, BOARD_TURNS_RAD = (320, 240), (24, 32, 40, 56), (0.0, 0.2, 0.5, 0.78)
FINE = 8
"""Samples of a pixel of a board, to each side."""
CORNER_PX, BORDER_PX = 6.0, 16
CORNERS = {"": "s", "found": ".2f", "off, median px": ".2f", "at most, px": ".2f", "into light fields, px": "+.2f"}
PAIRS = {"": "s", "repeatability": ".3f", "localization error, px": ".2f"}


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--weights", nargs="+", type=Path, default=NETWORKS, help="networks")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    folder = common.recordings(*SCENES, kind="vision")
    scenes = find_scenes([folder / name for name in SCENES])
    networks = choose_detectors([EvaluatedDetectorKind.ONNX], chosen.weights)
    refined = [replace(each, name=f"{each.name}, refined", find=partial(_refined, each)) for each in networks]
    with one_thread():
        shown = [*networks, *refined, *choose_detectors(CORNER_DETECTORS, ())]
        report.table("Corners", CORNERS, [(each.name, *_corner_row(each)) for each in shown])
        rows = [(each.name, *_repeated(each, scenes)) for each in (*networks, *refined)]
        report.table("Pairs of photographs", PAIRS, rows)
    report.write()


def _corner_row(detector: EvaluatedDetector) -> tuple[float, ...]:
    """Share of corners found, their median and longest distance, and by how much it lies along light fields."""
    rng, found, along = np.random.default_rng(1), list[FloatArray](), list[FloatArray]()
    for field, turn in itertools.product(FIELDS_PX, BOARD_TURNS_RAD):
        grey, corners, diagonals = _chequerboard(field, turn, rng.uniform(-4.0, 4.0, 2))
        keypoints = detector.find(FramedImage(Path(), BOARD, Framing(1.0, (0, 0)), grey)).keypoints_px
        distances, nearest = KDTree(keypoints).query(corners)
        along.append(np.abs(np.einsum("kdi,ki->kd", diagonals, keypoints[nearest] - corners)))
        found.append(distances)
    apart, (light, dark) = np.concatenate(found), np.concatenate(along).T
    near = apart <= CORNER_PX
    return float(near.mean()), float(np.median(apart[near])), apart[near].max(), float((light - dark)[near].mean())


def _chequerboard(field_px: int, turn_rad: float, shift_px: FloatArray) -> tuple[GreyImage, FloatArray, FloatArray]:
    """A board, its corners (K, 2), and the directions of each corner's light and dark fields (K, 2, 2)."""
    axes = np.array([[np.cos(turn_rad), np.sin(turn_rad)], [-np.sin(turn_rad), np.cos(turn_rad)]])
    middle = np.array(BOARD) / 2.0 + shift_px
    rows, columns = np.mgrid[: FINE * BOARD[1], : FINE * BOARD[0]]
    places = (np.stack((columns, rows), axis=-1) + 0.5) / FINE - 0.5
    is_light = np.floor((places - middle) @ axes.T / field_px).sum(axis=-1) % 2
    sharp = (60.0 + 130.0 * is_light).reshape(BOARD[1], FINE, BOARD[0], FINE).mean(axis=(1, 3))
    numbers = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), axis=-1).reshape(-1, 2)
    corners = middle + field_px * numbers @ axes
    inside = np.all((corners > BORDER_PX) & (corners < np.array(BOARD) - BORDER_PX), axis=1)
    diagonals = np.stack((axes[0] + axes[1], axes[0] - axes[1])) / np.sqrt(2.0)
    odd = numbers.sum(axis=1)[inside] % 2
    grey = np.asarray(np.round(cv2.GaussianBlur(sharp, (0, 0), 1.0)), np.uint8)
    return grey, corners[inside], np.where(odd[:, None, None] == 1, diagonals, diagonals[::-1])


def _refined(detector: EvaluatedDetector, picture: FramedImage) -> Keypoints:
    """Keypoints at the nearest corner of the picture."""
    found = detector.find(picture)
    return replace(found, keypoints_px=frozen(moved_to_corners(picture.grey, found.keypoints_px), np.float32))


def _repeated(detector: EvaluatedDetector, scenes: Sequence[Scene]) -> tuple[float, float]:
    """Repeatability and localization error of all pairs, as in the evaluation of homographies."""
    found = []
    for scene in scenes:
        first = frame(scene.reference, SMALL)
        keypoints = detector.find(first)
        for path, H in scene.others:
            other = frame(path, SMALL)
            true = framed_homography(H, first.framing, other.framing, HomographyGroundTruth.CORRECTED)
            pair = repeat_pair(keypoints, detector.find(other), true)
            found.append((pair.repeatability, pair.localization_error_px))
    repeatability, error = np.nanmean(found, axis=0)
    return float(repeatability), float(error)


if __name__ == "__main__":
    main()
