"""A fleet that begins from the detector that comes along: central training on the same images, and whether to ship it.

    FCSLAM_DATA=/path/to/data python benchmarks/federated_shipped.py --study FOLDER

Needs `fcslam[federated]` and `fcslam[sim]`. FOLDER holds all that is trained and measured; the same command goes on
where it was interrupted. The robots are those of federated.py,
with three times as many images; settings are the defaults, but for the number of rounds.

The first tables are of pairs of views of images that these robots held out, in the place where they train; gaps are to
central training, in points, with 95 % by paired bootstrap. Old codes are those of the detector that comes along, in the
first view of a pair. The last table is of photographs with known homographies that nobody ever trained on, as in
homography.py, at NMS 8: 25 pairs, one is four points of the homographies. Start is the detector that comes along; its
normalisations begin by drawn images, as those of a fleet without public images.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import common
from evaluation.detectors import EvaluatedDetectorKind, SceneKind, choose_detectors, find_scenes
from evaluation.federated.training_fleet import GAPS, TITLES, VISION, compare, gap_row, points, robots, run
from evaluation.homography import HomographyGroundTruth, difference, evaluate_homography, mean

from fcslam.features.detector import BUNDLED_NETWORK

if TYPE_CHECKING:
    from evaluation.homography import HomographyReport

SCENES = ("oxford_affine", "hpatches_subset")
ROUNDS, PAIRS, IMAGES = 40, 1000, 64
ARMS: dict[str, Any] = {"together": {}}
COMPARED = ("start", "central", *ARMS)
OTHERS = {"mma_3px_former": "MMA at 3 px with old codes in the first view, %", "repeatability": "Repeatability, %"}
SEED, NMS_PX = 1, 8
SHARE = ".3f"
ELSEWHERE = {"": "s", "repeatability, i": SHARE, "v": SHARE, "e=1": SHARE, "e=3": SHARE, "e=5": SHARE, "MMA@3": SHARE,
             "matching score": SHARE, "MMA@3 below shipped, points": "s"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--study", type=Path, help="folder of the study; the same one resumes")
    chosen = parser.parse_args()
    if chosen.study is None:
        print("skipped: takes an hour; name a folder by --study")
        return
    folder: Path = chosen.study.resolve()
    vision = common.recordings(*VISION.values(), *SCENES, kind="vision")
    content = {
        "federated": {"rounds": ROUNDS},
        "arms": ARMS,
        "seeds": 1,
        "local_seeds": 0,
        "pairs": PAIRS,
        "images": IMAGES,
        "start": BUNDLED_NETWORK,
    }
    findings = run(robots(vision, folder), folder / "shipped", content)
    report = common.Report(__file__, __doc__ or "", chosen)
    below = compare(findings, "central")
    for measure, title in (TITLES | OTHERS).items():
        report.table(title, GAPS, [gap_row(below[measure, arm]) for arm in COMPARED])
    networks = [BUNDLED_NETWORK, *(exported(folder / "shipped" / "seed1", arm) for arm in COMPARED[1:])]
    detectors = choose_detectors([EvaluatedDetectorKind.ONNX], networks)
    scenes = find_scenes([vision / name for name in SCENES])
    measured = evaluate_homography(scenes, detectors, HomographyGroundTruth.CORRECTED)
    report.table("Photographs of elsewhere", ELSEWHERE, elsewhere_rows(measured))
    report.write()


def exported(folder: Path, arm: str) -> Path:
    """What an arm came to, as robots run it."""
    from fcslam.learning.export import export_onnx
    from fcslam.learning.federated.initial_weights import read_detector_weights
    from fcslam.learning.federated.networks import weights_to_network

    target = folder / f"{arm}.onnx"
    export_onnx(weights_to_network(read_detector_weights(folder / arm / "checkpoint.state", "light"), "light"), target)
    return target


def elsewhere_rows(measured: "HomographyReport") -> Iterator[tuple[object, ...]]:
    shipped = measured.of(measured.detectors[0])
    for arm, name in zip(COMPARED, measured.detectors, strict=True):
        pairs = measured.of(name)
        kinds = (mean(pairs, "repeatability", kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT))
        corners = (mean(pairs, f"homography_{px}px_nms{NMS_PX}") for px in (1, 3, 5))
        right = f"accuracy_3px_nms{NMS_PX}"
        below = points(difference(shipped, pairs, right, SEED))
        yield f"{arm} ({name})", *kinds, *corners, mean(pairs, right), mean(pairs, f"score_nms{NMS_PX}"), below


if __name__ == "__main__":
    main()
