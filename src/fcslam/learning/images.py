"""Training images, from any folder tree."""

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from fcslam.errors import FeatureError, InputError
from fcslam.features.detector import GreyImage
from fcslam.features.files import read_grey

SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
SMALLEST_SIDE_PX: Final = 96
LARGEST_SIDE_PX: Final = 640
"""Larger images are scaled down to this, the resolution of a robot's camera; finer detail is mostly noise."""
FEWEST_CORNERS: Final = 60
CORNER_CONTRAST: Final = 15
"""Least contrast of a corner [grey levels]. Images with fewer corners, such as bare walls, are not used."""
HELD_OUT_SHARE: Final = 0.04
"""Share of the images that are kept for validation."""


@dataclass(frozen=True, slots=True)
class ImageFile:
    """An image on disk."""

    path: Path
    name: str
    """Path relative to the parent of the given folder, so it is the same wherever that folder lies."""


def find_images(roots: Sequence[Path]) -> list[ImageFile]:
    """All image files in the folder trees, sorted by name."""
    found: dict[str, ImageFile] = {}
    for root in roots:
        if not os.path.isdir(root):
            raise InputError(f"{root}: is not a folder; give a folder of images")
        base = root.resolve()
        files = [file for file in base.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file()]
        if not files:
            raise InputError(f"{root}: holds no image ({', '.join(sorted(SUFFIXES))}); give a folder of images")
        images = {name: ImageFile(file, name) for file in files for name in [file.relative_to(base.parent).as_posix()]}
        if found.keys() & images.keys():
            raise InputError(f"{root}: another folder has the same name and the same files; rename one of them")
        found |= images
    return [found[name] for name in sorted(found)]


def read_image(path: Path) -> GreyImage | None:
    """Read an image in grey levels, scaled down to ``LARGEST_SIDE_PX``; None if the file is not an image."""
    try:
        image = read_grey(path)
    except FeatureError:
        return None
    shrink = LARGEST_SIDE_PX / max(image.shape)
    if shrink < 1.0:
        image = np.asarray(cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), np.uint8)
    return image


def is_usable(image: GreyImage) -> bool:
    """Whether an image is large enough and has enough corners for training."""
    if min(image.shape) < SMALLEST_SIDE_PX:
        return False
    return len(cv2.FastFeatureDetector.create(threshold=CORNER_CONTRAST).detect(image)) >= FEWEST_CORNERS


def read_usable_images(roots: Sequence[Path]) -> list[GreyImage]:
    """The images below folders that can be trained on, at least one."""
    images = [image for file in find_images(roots) if (image := read_image(file.path)) is not None]
    usable = [image for image in images if is_usable(image)]
    if not usable:
        raise InputError(f"{roots[0]}: no image there is large enough and has enough corners; give more images")
    return usable


def is_held_out(name: str) -> bool:
    """Whether the image of this name is kept for validation: the same on every machine, whatever else is there."""
    return zlib.crc32(name.encode()) < HELD_OUT_SHARE * 2**32
