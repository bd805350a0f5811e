"""Detectors on scenes with known homographies, corrected and legacy ground truth.

    FCSLAM_DATA=/path/to/data python benchmarks/homography.py [--weights detector.onnx ...]
    python benchmarks/homography.py --scenes hpatches --csv pairs.csv

Scenes of the Oxford affine set and of HPatches, and pairs of the sets homogr and EVD, of which only some points are
known exactly. Other scenes come from `--scenes`. The estimate depends on the order of the matches: shares of right
homographies are means of 50 orders, by OpenCV's RANSAC and by its MAGSAC. Intervals are 95 % by bootstrap over scenes,
those of differences paired. NMS 0: keypoints as the detector gives them.

Of a network named NAME, NAME-logits is the same keypoints compared by the cosine of their 256 logits instead of by
bits: what it is ahead is what the bits cost. Times are processor time on one thread for all from the grey image to
described keypoints, 2000 of a network and 1500 of ORB and SIFT at most.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import common
from evaluation.detectors import SceneKind, choose_detectors, find_scenes
from evaluation.homography import (
    CORRECT_PX,
    ESTIMATORS,
    LARGE,
    MATCHING_NMS_PX,
    SMALL,
    HomographyGroundTruth,
    HomographyReport,
    difference,
    evaluate_homography,
    interval,
    mean,
    write_pairs,
)

from fcslam.features.detector import MATCHING_SCALES
from fcslam.metrics.bootstrap import Interval

SCENES = ("oxford_affine", "hpatches_subset", "homogr", "evd")
SEED = 1
LOGITS = "-logits"
BASELINES = ("sift", "orb")
SHARE = ".3f"
REPEATABILITY = {"": "s", "illumination": SHARE, "viewpoint": SHARE, "all": "s", "localization, px": ".2f",
                 "ms 320x240": ".1f", "ms 640x480": ".1f"}  # fmt: skip
ESTIMATES = [f"{name}_{px}px" for name in ESTIMATORS for px in CORRECT_PX]
NAMES = [f"{name}, e={px}" for name in ("RANSAC", "MAGSAC") for px in CORRECT_PX]
MATCHING = {"": "s", "NMS": "d", "i, e=3": SHARE, "v, e=3": SHARE, **dict.fromkeys(NAMES, SHARE), "MMA@1": SHARE,
            "MMA@3": "s", "MMA@5": SHARE, "matching score": SHARE}  # fmt: skip
AHEAD = {"": "s", "less": "s", "NMS": "d", **dict.fromkeys((*NAMES, "MMA@3"), "s")}
BITS = {"": "s", "NMS": "d", "e=1": "s", "e=3": "s", "e=5": "s", "MMA@1": "s", "MMA@3": "s", "matching score": "s"}
SCENE_MEASURES = ("homography_3px", "accuracy_3px", "score")
BY_SCENE = {"scene": "s", "": "s", "repeatability": SHARE} | {
    f"{name}, NMS {nms_px}": SHARE for nms_px in MATCHING_NMS_PX for name in ("e=3", "MMA@3", "score")
}


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--weights", nargs="+", type=Path, default=[], help="networks, if not the one of fcslam")
    parser.add_argument("--scenes", nargs="+", type=Path, help="folders of other scenes, in the layout of HPatches")
    parser.add_argument("--scales", nargs="+", type=float, default=MATCHING_SCALES, help="image pyramid of networks")
    parser.add_argument("--csv", type=Path, help="file for all measures of all pairs")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    scenes = find_scenes(chosen.scenes or [common.recordings(*SCENES, kind="vision") / name for name in SCENES])
    detectors = choose_detectors([], chosen.weights, tuple(chosen.scales))
    for truth in HomographyGroundTruth:
        is_legacy = truth is HomographyGroundTruth.LEGACY
        measured = evaluate_homography([s for s in scenes if not (is_legacy and s.marks)], detectors, truth)
        report.table(f"Repeatability, {truth}", REPEATABILITY, _repeatability(measured))
        report.table(f"Homography and matching, {truth}", MATCHING, _matching(measured))
        if not is_legacy:
            report.table(f"Networks ahead of others, {truth}", AHEAD, _ahead(measured))
            if chosen.csv is not None:
                write_pairs(measured, chosen.csv)
            report.table(f"Bits less logits, {truth}", BITS, _bits_less_logits(measured))
            report.table(f"Scene by scene, {truth}", BY_SCENE, _by_scene(measured))
    report.write()


def _repeatability(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    for name in measured.detectors:
        if name.endswith(LOGITS):
            continue
        pairs = measured.of(name)
        yield (
            name,
            *(mean(pairs, "repeatability", kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT)),
            _shown(interval(pairs, "repeatability", SEED)),
            mean(pairs, "localization_error_px"),
            *(measured.milliseconds.get((name, size), math.nan) for size in (SMALL, LARGE)),
        )


def _matching(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    for nms_px in MATCHING_NMS_PX:
        for name in measured.detectors:
            pairs = measured.of(name)
            if not pairs[0].matching:
                continue
            correct, right = f"homography_3px_nms{nms_px}", f"accuracy_3px_nms{nms_px}"
            yield (
                name,
                nms_px,
                *(mean(pairs, correct, kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT)),
                *(mean(pairs, f"{estimate}_nms{nms_px}") for estimate in ESTIMATES),
                mean(pairs, f"accuracy_1px_nms{nms_px}"),
                _shown(interval(pairs, right, SEED)),
                mean(pairs, f"accuracy_5px_nms{nms_px}"),
                mean(pairs, f"score_nms{nms_px}"),
            )


def _ahead(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    described = [name for name in measured.detectors if measured.of(name)[0].matching]
    for nms_px in MATCHING_NMS_PX:
        for name in described:
            for other in BASELINES if name not in BASELINES and not name.endswith(LOGITS) else ():
                pairs, others = measured.of(name), measured.of(other)
                gaps = (difference(pairs, others, f"{one}_nms{nms_px}", SEED) for one in (*ESTIMATES, "accuracy_3px"))
                yield name, other, nms_px, *(_shown(gap, "+") for gap in gaps)


def _bits_less_logits(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    measures = (*(f"homography_{px}px" for px in (1, 3, 5)), "accuracy_1px", "accuracy_3px", "score")
    for nms_px in MATCHING_NMS_PX:
        for name in measured.detectors:
            if name + LOGITS in measured.detectors:
                bits, logits = measured.of(name), measured.of(name + LOGITS)
                gaps = (difference(bits, logits, f"{measure}_nms{nms_px}", SEED) for measure in measures)
                yield name, nms_px, *(_shown(gap, "+") for gap in gaps)


def _by_scene(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    measures = ["repeatability", *(f"{name}_nms{nms_px}" for nms_px in MATCHING_NMS_PX for name in SCENE_MEASURES)]
    for scene in dict.fromkeys(pair.scene for pair in measured.pairs):
        for name in measured.detectors:
            pairs = [pair for pair in measured.of(name) if pair.scene == scene]
            yield scene, name, *(mean(pairs, measure) for measure in measures)


def _shown(value: Interval, sign: str = "") -> str:
    return f"{value.mean:{sign}.3f} [{value.low:{sign}.2f}, {value.high:{sign}.2f}]"


if __name__ == "__main__":
    main()
