"""What detectors do when an image is shifted by whole pixels, or turned.

    FCSLAM_DATA=/path/to/data python benchmarks/equivariance.py [--weights detector.onnx ...]

The first images of five scenes at 640 x 480. Shift: rolled right and down by so many pixels; of the 500 strongest
keypoints away from the edges, the share that is found again within 1 px among the 500 strongest there. A detector that
works in cells of 8 x 8 pixels gives itself away here. FAST, Harris and Shi keep 600 corners of an image, some of which
lie on the seam of a rolled one: that alone costs them the last 0.05. Turn: about the middle; the matching accuracy at
3 px, without NMS, and the share of the homographies that are right to 3 px.
"""

from collections.abc import Sequence
from pathlib import Path

import common
import cv2
import numpy as np
from evaluation.detectors import (
    EvaluatedDetector,
    EvaluatedDetectorKind,
    FramedImage,
    choose_detectors,
    find_scenes,
    frame,
    one_thread,
)
from evaluation.homography import LARGE, described, match_pair
from numpy.typing import NDArray
from scipy.spatial import KDTree

from fcslam.features.detector import GreyImage

SCENES = ("oxford_affine", "hpatches_subset")
DETECTORS = [name for name in EvaluatedDetectorKind if name is not EvaluatedDetectorKind.LOGITS]
SHIFTS_PX = tuple(range(1, 9))
ANGLES_DEG = tuple(range(0, 181, 15))
STRONGEST, NEAR_PX = 500, 1.0
MARGIN_PX = 40
"""Where nothing of the seam is seen that a rolled image has."""


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--weights", nargs="+", type=Path, default=[], help="networks, if not the one of fcslam")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    folder = common.recordings(*SCENES, kind="vision")
    pictures = [frame(scene.reference, LARGE) for scene in find_scenes([folder / name for name in SCENES])]
    detectors = choose_detectors(DETECTORS, chosen.weights)
    with one_thread():
        columns = {"": "s"} | {f"{shift} px": ".3f" for shift in SHIFTS_PX}
        report.table("Shift: keypoints found again", columns, [_shift_row(each, pictures) for each in detectors])
        matched = [each for each in detectors if hasattr(each.find(pictures[0]), "descriptors")]
        turned = [(each, [_turned(each, pictures, angle) for angle in ANGLES_DEG]) for each in matched]
    columns = {"": "s"} | {f"{angle} deg": ".2f" for angle in ANGLES_DEG}
    report.table("Turn: MMA@3", columns, [(each.name, *(row[0] for row in rows)) for each, rows in turned])
    report.table("Turn: homography e=3", columns, [(each.name, *(row[1] for row in rows)) for each, rows in turned])
    report.write()


def _shift_row(detector: EvaluatedDetector, pictures: Sequence[FramedImage]) -> tuple[str | float, ...]:
    return detector.name, *(
        float(np.mean([_found_again(detector, picture, shift) for picture in pictures])) for shift in SHIFTS_PX
    )


def _found_again(detector: EvaluatedDetector, picture: FramedImage, shift: int) -> float:
    rolled = _changed(picture, np.roll(picture.grey, (shift, shift), (0, 1)))
    expected = _central(detector.find(picture).keypoints_px + np.float32(shift))
    found = _central(detector.find(rolled).keypoints_px)
    return float(np.mean(KDTree(found).query(expected)[0] <= NEAR_PX))


def _central(positions_px: NDArray[np.float32]) -> NDArray[np.float32]:
    inside = np.all((positions_px > MARGIN_PX) & (positions_px < np.array(LARGE) - MARGIN_PX), axis=1)
    return positions_px[inside][:STRONGEST]


def _turned(detector: EvaluatedDetector, pictures: Sequence[FramedImage], angle_deg: float) -> tuple[float, float]:
    """MMA@3 and the share of right homographies."""
    H = _rotation(angle_deg)
    results = []
    for picture in pictures:
        turned = np.asarray(cv2.warpPerspective(picture.grey, H, LARGE), np.uint8)
        found = (described(detector.find(each)) for each in (picture, _changed(picture, turned)))
        results.append(match_pair(*found, H))
    shares = [(result.accuracy[2], np.mean(result.errors_px[0] <= 3.0)) for result in results]
    accuracy, correct = np.mean(shares, axis=0)
    return float(accuracy), float(correct)


def _rotation(angle_deg: float) -> NDArray[np.float64]:
    """H (3, 3) that turns a picture about its middle."""
    middle = (0.5 * (LARGE[0] - 1), 0.5 * (LARGE[1] - 1))
    return np.vstack((cv2.getRotationMatrix2D(middle, angle_deg, 1.0), (0.0, 0.0, 1.0)))


def _changed(picture: FramedImage, grey: GreyImage) -> FramedImage:
    return FramedImage(picture.path, picture.file_size, picture.framing, np.ascontiguousarray(grey))


if __name__ == "__main__":
    main()
