"""Scenes of a plane or a turning camera, in the layout of HPatches (Balntas et al. 2017).

A scene is a folder with images ``1.*``, ``2.*`` ... and text files ``H_1_2``, ``H_1_3`` ..., 3 x 3 numbers each, which
map pixels of image 1 to the other image. Its name begins with ``i_`` if the illumination changes, with ``v_`` if the
viewpoint changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from fcslam.errors import EvaluationError
from fcslam.records import FloatArray, frozen
from fcslam.untrusted import read_text


class SceneKind(StrEnum):
    """Change between the images of a scene, from its name."""

    ILLUMINATION = "i"
    VIEWPOINT = "v"
    OTHER = "-"

    @classmethod
    def of(cls, name: str) -> "SceneKind":
        """The kind of a scene with this name."""
        return cls(name[0]) if name.startswith(("i_", "v_")) else cls.OTHER


@dataclass(frozen=True, slots=True)
class Scene:
    """Images of one scene with known homographies."""

    folder: Path
    reference: Path
    """Image 1."""
    others: tuple[tuple[Path, FloatArray], ...]
    """The other images, each with H (3, 3) from image 1 to it."""

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name

    @property
    def kind(self) -> SceneKind:
        """Change between its images."""
        return SceneKind.of(self.name)


def find_scenes(folders: Sequence[Path]) -> list[Scene]:
    """Find scenes, sorted by name. Each folder is a scene, or contains scenes.

    Raises:
        EvaluationError: a folder is or holds none, two scenes have one name, or a scene's files do not fit together.
    """
    scenes: dict[str, Scene] = {}
    for folder in folders:
        found = [place for place in (folder, *sorted(folder.glob("*/"))) if any(place.glob("H_1_*"))]
        if not found:
            raise EvaluationError(f"{folder}: no scene in it; a scene is a folder with images 1, 2 ... and H_1_2 ...")
        for place in found:
            if place.name in scenes:
                raise EvaluationError(f"{place}: there is another scene {place.name}; rename one")
            scenes[place.name] = _read_scene(place)
    return [scenes[name] for name in sorted(scenes)]


def _read_scene(folder: Path) -> Scene:
    images = {int(path.stem): path for path in sorted(folder.iterdir()) if path.suffix and path.stem.isdecimal()}
    files = sorted(folder.glob("H_1_*"))
    numbers = [path.name.removeprefix("H_1_") for path in files]
    wrong = [path.name for path, number in zip(files, numbers, strict=True) if not number.isdecimal()]
    missing = [number for number in ("1", *numbers) if number.isdecimal() and int(number) not in images]
    if wrong or missing:
        raise EvaluationError(f"{folder}: {f'what is {wrong[0]}?' if wrong else f'image {missing[0]} is missing'}")
    pairs = sorted((int(number), path) for number, path in zip(numbers, files, strict=True))
    return Scene(folder, images[1], tuple((images[number], _read_homography(path)) for number, path in pairs))


def _read_homography(path: Path) -> FloatArray:
    try:
        H = np.array([float(word) for word in read_text(path).split()])
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot read the homography ({error}); give 3 x 3 numbers") from error
    if H.shape != (9,) or not np.isfinite(H).all() or H[8] == 0.0 or abs(np.linalg.det(H.reshape(3, 3))) < 1e-12:
        raise EvaluationError(f"{path}: no homography; give 3 x 3 finite numbers that can be inverted")
    return frozen(H.reshape(3, 3) / H[8])
