"""Does the exported detector say what the trained one says, and what does int8 cost?

    FCSLAM_DATA=/path/to/data python benchmarks/export_agreement.py --training FOLDER

FOLDER is what `fcslam tools train` wrote: its two ONNX files, and the checkpoint that they were made from, for which
torch is needed (`fcslam[train]`). Images: those of the scenes of `benchmarks/homography.py` at 640 x 480. Bits are
compared at the 1000 strongest keypoints of the float32 file, the same positions for all, so that only the logits
differ. Then both files on the pairs of the scenes; intervals are 95 % by paired bootstrap over pairs.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import common
import numpy as np
from homography import SCENES, SEED

from fcslam.features.dense import Logits, Probabilities, sample_codes
from fcslam.features.detector import GreyImage, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import EvaluatedDetectorKind
from fcslam.lab.evaluation.detectors.evaluated_detectors import choose_detectors, frame, one_thread
from fcslam.lab.evaluation.detectors.homography import (
    LARGE,
    MATCHED,
    MATCHING_NMS_PX,
    HomographyReport,
    evaluate_homography,
)
from fcslam.lab.evaluation.detectors.measures import difference, mean
from fcslam.lab.evaluation.detectors.scenes import Scene, find_scenes

Network = Callable[[GreyImage], tuple[Probabilities, Logits]]
BITS = {"compared": "s", "images": "d", "codes": "d", "bits that differ, %": ".4f", "in the worst image, %": ".4f",
        "largest difference of a score": ".6f"}  # fmt: skip
MEASURES = {"repeatability": "repeatability"} | {
    f"{title}, NMS {nms_px}": f"{name}_nms{nms_px}"
    for nms_px in MATCHING_NMS_PX
    for title, name in (("MMA@3", "accuracy_3px"), ("e=3", "homography_3px"), ("score", "score"))
}


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--training", type=Path, help="folder of a training run")
    chosen = parser.parse_args()
    if chosen.training is None:
        print("skipped: needs a training run; name its folder by --training")
        sys.exit(0)
    report = common.Report(__file__, __doc__ or "", chosen)
    folder = common.recordings(*SCENES, kind="vision")
    scenes = find_scenes([folder / name for name in SCENES])
    paths = [chosen.training / name for name in ("detector.onnx", "detector-int8.onnx")]
    floating, small = (OnnxDetector(OnnxConfig(weights=path, most_features=MATCHED)) for path in paths)
    images = _images(scenes)
    with one_thread():
        compared = {f"float32 and int8, {small.version}": small.infer}
        if importlib.util.find_spec("torch"):
            trained = _trained(chosen.training / "joint" / "checkpoint.npz", floating.version)
            compared = {f"torch and float32, {floating.version}": trained} | compared
        else:
            report.say("Torch is not installed, so the checkpoint was not compared; install fcslam[train].")
        rows = (_bits_row(name, floating, other, images) for name, other in compared.items())
        report.table("Bits", BITS, rows)
    measured = evaluate_homography(scenes, choose_detectors([EvaluatedDetectorKind.ONNX], paths, []))
    report.table("On the scenes", {"": "s"} | dict.fromkeys(MEASURES, "s"), _scene_rows(measured))
    report.write()


def _images(scenes: Sequence[Scene]) -> list[GreyImage]:
    paths = (path for scene in scenes for path in (scene.reference, *(path for path, _ in scene.others)))
    return [frame(path, LARGE).grey for path in paths]


def _trained(checkpoint: Path, version: str) -> Network:
    """The checkpoint's network, which must be the one of that version."""
    import torch

    from fcslam.learning.export import detector_version
    from fcslam.learning.trainer import trained_network

    torch.set_num_threads(1)
    network = trained_network(checkpoint)
    if detector_version(network) != version:
        sys.exit(f"{checkpoint}: holds {detector_version(network)}, but detector.onnx is {version}; export it anew")

    def infer(image: GreyImage) -> tuple[Probabilities, Logits]:
        with torch.inference_mode():
            outputs = network(torch.from_numpy(image.astype(np.float32) / np.float32(255.0))[None, None])
            return network.scores(outputs)[0].numpy(), outputs.code_logits[0].numpy()

    return infer


def _bits_row(name: str, reference: OnnxDetector, other: Network, images: Sequence[GreyImage]) -> tuple[object, ...]:
    shares, codes, largest = [], 0, 0.0
    for image in images:
        found = reference.detect(image)
        scores, logits = other(image)
        bits = np.unpackbits(found.descriptors ^ sample_codes(logits, found.keypoints_px))
        shares.append(100.0 * float(bits.mean()))
        codes += len(found.scores)
        largest = max(largest, float(np.abs(scores - reference.infer(image)[0]).max()))
    return name, len(images), codes, float(np.mean(shares)), max(shares), largest


def _scene_rows(measured: HomographyReport) -> Iterator[tuple[str, ...]]:
    floating, small = (measured.of(name) for name in measured.detectors)
    for name in measured.detectors:
        yield name, *(f"{mean(measured.of(name), measure):.3f}" for measure in MEASURES.values())
    gaps = (difference(small, floating, measure, SEED) for measure in MEASURES.values())
    yield "int8 less float32", *(f"{gap.mean:+.3f} [{gap.low:+.3f}, {gap.high:+.3f}]" for gap in gaps)


if __name__ == "__main__":
    main()
