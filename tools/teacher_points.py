"""Keypoints and descriptors of a teacher, for `fcslam tools train --teacher`: ALIKED (Zhao et al. 2023) by kornia.

    python tools/teacher_points.py WEIGHTS IMAGES... --output TEACHER

Needs torch and kornia (`pip install --no-deps kornia kornia_rs`), which fcslam itself never does. Each image gets one
`PATH.npz` below TEACHER, its PATH beginning with the name of its folder IMAGES: `keypoints` (N, 2) float32 x, y
in pixels, `scores` (N,) float32, `descriptors` (N, 128) float16. Images that have one are skipped, so an interrupted
run goes on where it was.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from kornia.feature import ALIKED

from fcslam.features.detector import GreyImage
from fcslam.learning.images import find_images, read_image
from fcslam.storage.files import replacing

MOST_POINTS = 800
SUPPRESSION_RADIUS_PX = 2


def main() -> None:
    """Read the arguments and write one file an image."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    teacher = ALIKED(
        "aliked-n16", max_num_keypoints=MOST_POINTS, detection_threshold=0.0, nms_radius=SUPPRESSION_RADIUS_PX
    ).eval()
    teacher.load_state_dict(torch.load(arguments.weights, map_location="cpu", weights_only=True), strict=False)
    for file in find_images(arguments.images):
        image = read_image(file.path)
        target = arguments.output / f"{file.name}.npz"
        if image is not None and not target.exists():
            write_points(teacher, image, target)


@torch.inference_mode()
def write_points(teacher: ALIKED, image: GreyImage, target: Path) -> None:
    """Describe one image; the file appears only when it is complete."""
    (points,) = teacher(torch.from_numpy(image).float()[None, None].expand(1, 3, -1, -1) / 255.0)
    arrays = {
        "keypoints": points.keypoints.numpy().astype(np.float32),
        "scores": points.keypoint_scores.numpy().astype(np.float32),
        "descriptors": points.descriptors.numpy().astype(np.float16),
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as unfinished, unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


if __name__ == "__main__":
    main()
