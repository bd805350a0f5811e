"""Does the exported detector say what the trained one says?

    FCSLAM_DATA=/path/to/data python benchmarks/export_agreement.py --training FOLDER

FOLDER is what `fcslam tools train` wrote: its ONNX file, and the checkpoint it was made from, for which torch is needed
(`fcslam[train]`). Images: those of the scenes of `benchmarks/homography.py` at 640 x 480. Bits are compared at the 1000
strongest keypoints of the file, the same positions for both, so that only the logits differ.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import common
import numpy as np
from evaluation.detectors import Scene, find_scenes, frame, one_thread
from evaluation.homography import LARGE, MATCHED
from homography import SCENES

from fcslam.features.dense import Logits, Probabilities, sample_codes
from fcslam.features.detector import GreyImage, OnnxConfig, OnnxDetector

Network = Callable[[GreyImage], tuple[Probabilities, Logits]]
BITS = {"compared": "s", "images": "d", "codes": "d", "bits that differ, %": ".4f", "in the worst image, %": ".4f",
        "largest difference of a score": ".6f"}  # fmt: skip


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
    exported = OnnxDetector(OnnxConfig(weights=chosen.training / "detector.onnx", most_features=MATCHED))
    with one_thread():
        trained = _trained(chosen.training / "joint" / "checkpoint.state", exported.version)
        report.table(
            "Bits", BITS, [_bits_row(f"torch and the file, {exported.version}", exported, trained, _images(scenes))]
        )
    report.write()


def _images(scenes: Sequence[Scene]) -> list[GreyImage]:
    paths = (path for scene in scenes for path in (scene.reference, *(path for path, _ in scene.others)))
    return [frame(path, LARGE).grey for path in paths]


def _trained(checkpoint: Path, version: str) -> Network:
    """The checkpoint's network, which must be the one of that version."""
    import torch

    from fcslam.learning.export import detector_version
    from fcslam.learning.network import network_from_state
    from fcslam.learning.trainer import CHECKPOINT_FORMAT
    from fcslam.storage.state_file import read_state

    torch.set_num_threads(1)
    trained = read_state(checkpoint, CHECKPOINT_FORMAT)
    if trained is None:
        sys.exit(f"{checkpoint}: is not there")
    average = {name: torch.from_numpy(array) for name, array in trained["average"].items()}
    network = network_from_state(trained["settings"]["encoder"], average)
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


if __name__ == "__main__":
    main()
