"""Detectors on 500 made pairs: what the bits of a descriptor cost, told apart from chance.

    FCSLAM_DATA=/path/to/data python benchmarks/made_pairs.py [--weights detector.onnx ...]

The scenes of `benchmarks/homography.py` have 25 pairs, too few for a difference of two hundredths. Here 250 images, 84
or 83 each of an office corridor, a desk and the floors 11 to 15 of a tower, none of them trained on, and of each two
copies under a random homography, light, blur and noise, drawn as training draws them. The truth is exact and the kind
of change is one that training knew; the images it did not. At 640 x 480, matching as there; 95 % intervals by bootstrap
over pairs, those of differences paired. NAME-logits: the same keypoints compared by the cosine of their 256 logits.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import common
import cv2
import numpy as np
from evaluation.detectors import EvaluatedDetectorKind, choose_detectors, find_scenes
from evaluation.homography import MATCHING_NMS_PX, HomographyReport, difference, evaluate_homography, interval, mean

from fcslam.features.files import read_grey
from fcslam.learning.warps import random_change, relight, warp_image
from fcslam.metrics.bootstrap import Interval

SOURCES = {
    "rtabmap_corridor": ("*.jpg",),
    "tum_rgbd/freiburg1_rpy": ("rgb/*",),
    "ie_tower": tuple(f"floor{floor}/*.jpg" for floor in range(11, 16)),
}
IMAGES, COPIES = 250, 2
SEED = 1
DETECTORS = (
    EvaluatedDetectorKind.ONNX,
    EvaluatedDetectorKind.LOGITS,
    EvaluatedDetectorKind.ORB,
    EvaluatedDetectorKind.SIFT,
)
LOGITS = "-logits"
MEASURES = {"e=1": "homography_1px", "e=3": "homography_3px", "e=5": "homography_5px", "MMA@3": "accuracy_3px",
            "matching score": "score"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--weights", nargs="+", type=Path, default=[], help="networks, if not the one of fcslam")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    folder = common.recordings(*SOURCES, kind="vision")
    with tempfile.TemporaryDirectory() as made:
        scenes = make_scenes(folder, Path(made), IMAGES)
        measured = evaluate_homography(find_scenes(scenes), choose_detectors(DETECTORS, chosen.weights))
    columns = {"": "s", "NMS": "d", "repeatability": "s"} | dict.fromkeys(MEASURES, "s")
    report.table("Homography and matching", columns, _rows(measured))
    columns = {"": "s", "NMS": "d"} | dict.fromkeys(MEASURES, "s")
    report.table("Bits less logits", columns, _bits_less_logits(measured))
    report.write()


def make_scenes(folder: Path, made: Path, images: int) -> list[Path]:
    """A scene for every image: itself, and its copies with their homographies."""
    scenes = []
    for number, path in enumerate(_images(folder, images)):
        rng = np.random.default_rng([SEED, number])
        scene = made / f"v_{number:03}"
        scene.mkdir()
        image = read_grey(path)
        size = (image.shape[1], image.shape[0])
        cv2.imwrite(str(scene / "1.png"), image)
        for copy in range(2, 2 + COPIES):
            H = random_change(size, rng)
            view = relight(warp_image(image, H, size), rng)
            cv2.imwrite(str(scene / f"{copy}.png"), np.rint(255.0 * view).astype(np.uint8))
            np.savetxt(scene / f"H_1_{copy}", H)
        scenes.append(scene)
    return scenes


def _images(folder: Path, count: int) -> list[Path]:
    """As many of every source, spread over it."""
    chosen: list[Path] = []
    for left, (name, patterns) in zip(range(len(SOURCES), 0, -1), SOURCES.items(), strict=True):
        files = sorted(path for pattern in patterns for path in (folder / name).glob(pattern))
        wanted = -(-(count - len(chosen)) // left)
        chosen += [files[row] for row in np.linspace(0, len(files) - 1, wanted).round().astype(int)]
    return chosen


def _rows(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    for nms_px in MATCHING_NMS_PX:
        for name in measured.detectors:
            pairs = measured.of(name)
            values = (_shown(interval(pairs, f"{each}_nms{nms_px}", SEED)) for each in MEASURES.values())
            yield name, nms_px, f"{mean(pairs, 'repeatability'):.3f}", *values


def _bits_less_logits(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    for nms_px in MATCHING_NMS_PX:
        for name in measured.detectors:
            if f"{name}{LOGITS}" in measured.detectors:
                pairs = measured.of(name), measured.of(f"{name}{LOGITS}")
                gaps = (difference(*pairs, f"{each}_nms{nms_px}", SEED) for each in MEASURES.values())
                yield name, nms_px, *(_shown(gap, sign="+") for gap in gaps)


def _shown(found: Interval, sign: str = "") -> str:
    return f"{found.mean:{sign}.3f} [{found.low:{sign}.3f}, {found.high:{sign}.3f}]"


if __name__ == "__main__":
    main()
