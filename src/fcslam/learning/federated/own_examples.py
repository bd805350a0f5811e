"""Examples of one robot: what it saw again in its own map."""

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import GreyImage, decode_grey, padded
from fcslam.geometry import se2
from fcslam.learning.code_batches import RevisitExamples, RevisitPair
from fcslam.learning.federated.held_out import HeldOutPairs
from fcslam.learning.revisits import Keyframe, revisits_in_map
from fcslam.records import FloatArray
from fcslam.robot.keyframe_folder import KeptKeyframe, read_keyframes
from fcslam.storage.files import write_file

MOST_KEYFRAMES: Final = 400
"""Newest keyframes that are compared with one another."""
HELD_OUT_EVERY: Final = 4
"""One in this many squares of the robot's map is held out from training."""
HELD_OUT_SIDE_M: Final = 4.0
"""Side of these squares."""
SPLIT_FILE: Final = "split.json"
"""Says of each keyframe that was ever used whether it is held out."""


def own_examples(folder: Path, side_m: float = HELD_OUT_SIDE_M) -> tuple[RevisitExamples, HeldOutPairs]:
    """What a robot saw again by its keyframes: examples to train on, and pairs that are held out.

    ``side_m``: of the squares of the map that are held out as a whole.
    """
    kept = read_keyframes(folder, MOST_KEYFRAMES)
    version = kept[-1].detector_version if kept else ""
    shown = [(frame, picture) for frame in kept if (picture := _picture(frame, version)) is not None]
    held_out = _split(folder / SPLIT_FILE, [frame for frame, _ in shown], side_m)
    trained = [each for each, is_held_out in zip(shown, held_out, strict=True) if not is_held_out]
    judged = [each for each, is_held_out in zip(shown, held_out, strict=True) if is_held_out]
    frames, poses = _keyframes(trained)
    pairs = [_pair(frames, poses, i, j, rows) for i, j, rows in revisits_in_map(frames, poses)]
    examples = RevisitExamples([frame.image for frame in frames], pairs)
    return examples, HeldOutPairs.of(*_keyframes(judged))


def _picture(frame: KeptKeyframe, version: str) -> GreyImage | None:
    """The image of a keyframe that the present detector described, in whole cells; None for another one, or if it is
    broken."""
    picture = decode_grey(frame.image.encoded) if frame.detector_version == version else None
    return None if picture is None else padded(picture)


def _split(path: Path, frames: Sequence[KeptKeyframe], side_m: float) -> list[bool]:
    """Which keyframes are held out; what was decided once stays, wherever the map moves."""
    known: dict[str, bool] = {}
    with suppress(OSError, ValueError, AttributeError):
        known = {str(name): bool(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
    names = [f"{frame.session}-{frame.image.keyscan}" for frame in frames]
    for name, frame in zip(names, frames, strict=True):
        known.setdefault(name, is_held_out(frame.T_own_base, side_m))
    write_file(path, json.dumps(known))
    return [known[name] for name in names]


def is_held_out(T_own_base: FloatArray, side_m: float) -> bool:
    """Whether a new keyframe at this pose in the robot's own map, shape (3,), is held out."""
    column, row = (math.floor(float(each) / side_m) for each in T_own_base[:2])
    # Neither a row nor a column of squares is held out as a whole, or not at all.
    return (column + (HELD_OUT_EVERY // 2) * row) % HELD_OUT_EVERY == 0


def _keyframes(shown: Sequence[tuple[KeptKeyframe, GreyImage]]) -> tuple[list[Keyframe], FloatArray]:
    frames = [
        Keyframe.of(picture, frame.features, frame.image.camera, frame.image.surroundings) for frame, picture in shown
    ]
    return frames, np.array([frame.T_own_base for frame, _ in shown]).reshape(-1, 3)


def _pair(frames: Sequence[Keyframe], poses: FloatArray, i: int, j: int, rows: NDArray[np.int64]) -> RevisitPair:
    points = frames[i].features.keypoints_px[rows[:, 0]], frames[j].features.keypoints_px[rows[:, 1]]
    return RevisitPair((i, j), points, _in_map(frames[i], poses[i])[rows[:, 0]])


def _in_map(frame: Keyframe, T_own_base: FloatArray) -> FloatArray:
    """Positions of a frame's keypoints in the robot's map, shape (K, 3); of no meaning without one."""
    positions = frame.positions.copy()
    positions[:, :2] = se2.transform(T_own_base, positions[:, :2])
    return positions
