"""Detectors on scenes with known homographies, corrected and legacy ground truth.

    FCSLAM_DATA=/path/to/data python benchmarks/homography.py

Four scenes of the Oxford affine set and one of HPatches, at most 640 pixels wide: 25 pairs, so differences of a few
hundredths are chance; intervals are 95 % by bootstrap over pairs. NMS 0: keypoints as the detector gives them. Times
are for one thread.
"""

import math
from collections.abc import Iterator

import common

from fcslam.evaluation.contenders import choose_contenders
from fcslam.evaluation.homography import LARGE, MATCHING_NMS_PX, SMALL, HomographyReport, evaluate_homography
from fcslam.evaluation.homography_measures import difference, interval, mean
from fcslam.evaluation.scenes import SceneKind, find_scenes
from fcslam.metrics.bootstrap import Interval
from fcslam.metrics.framing import GroundTruth

SCENES = ("oxford_affine", "hpatches_subset")
SEED = 1
BASELINE = "orb"


def main() -> None:
    report = common.Report(__file__, __doc__ or "", common.options(__doc__ or "").parse_args())
    folder = common.recordings(*SCENES, kind="vision")
    scenes, contenders = find_scenes([folder / name for name in SCENES]), choose_contenders([], None, [])
    share = ".3f"
    for truth in GroundTruth:
        measured = evaluate_homography(scenes, contenders, truth)
        columns = {"": "s", "illumination": share, "viewpoint": share, "all": "s", "localisation, px": ".2f"}
        times = {"ms 320x240": ".1f", "ms 640x480": ".1f"}
        report.table(f"Repeatability, {truth}", columns | times, _repeatability(measured))
        columns = {"": "s", "NMS": "d", "i, e=3": share, "v, e=3": share, "e=1": share, "e=3": "s", "e=5": share}
        columns |= {"MMA@1": share, "MMA@3": "s", "MMA@5": share, "matching score": share, "MMA@3 above ORB": "s"}
        report.table(f"Homography and matching, {truth}", columns, _matching(measured))
    report.write()


def _repeatability(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    for name in measured.contenders:
        pairs = measured.of(name)
        yield (
            name,
            *(mean(pairs, "repeatability", kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT)),
            _shown(interval(pairs, "repeatability", SEED)),
            mean(pairs, "localisation_error_px"),
            *(measured.milliseconds.get((name, size), math.nan) for size in (SMALL, LARGE)),
        )


def _matching(measured: HomographyReport) -> Iterator[tuple[object, ...]]:
    for nms_px in MATCHING_NMS_PX:
        for name in measured.contenders:
            pairs = measured.of(name)
            if not pairs[0].matching:
                continue
            correct, right = f"homography_3px_nms{nms_px}", f"accuracy_3px_nms{nms_px}"
            yield (
                name,
                nms_px,
                *(mean(pairs, correct, kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT)),
                mean(pairs, f"homography_1px_nms{nms_px}"),
                _shown(interval(pairs, correct, SEED)),
                mean(pairs, f"homography_5px_nms{nms_px}"),
                mean(pairs, f"accuracy_1px_nms{nms_px}"),
                _shown(interval(pairs, right, SEED)),
                mean(pairs, f"accuracy_5px_nms{nms_px}"),
                mean(pairs, f"score_nms{nms_px}"),
                _shown(difference(pairs, measured.of(BASELINE), right, SEED)),
            )


def _shown(value: Interval) -> str:
    return f"{value.mean:.3f} [{value.low:.2f}, {value.high:.2f}]"


if __name__ == "__main__":
    main()
