"""Examples of one robot: revisits in its own map, and codes that the fleet gave to its own points."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import GreyImage, decode_grey, padded
from fcslam.geometry import se2
from fcslam.learning.federated.held_out import HeldOutPairs
from fcslam.learning.federated.live_settings import HeldOutSettings, RobotLearningSettings
from fcslam.learning.revisit_batches import RevisitExamples, RevisitPair, TaughtImage, vote
from fcslam.learning.revisits import FEWEST_SHARED, Keyframe, revisits_in_map
from fcslam.records import FloatArray
from fcslam.robot.keyframe_folder import KeptKeyframe, read_keyframes
from fcslam.storage.files import write_file
from fcslam.wire.messages import Packet, TaughtPlace
from fcslam.wire.quantisation import quantise_keypoints
from fcslam.wire.streams import ascending

SPLIT_FILE: Final = "split.json"
"""Says of each keyframe that was ever used whether it is held out."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnExamples:
    """Examples to train on, and pairs that are held out from training."""

    revisits: RevisitExamples
    held_out: HeldOutPairs


def own_examples(
    folder: Path, settings: RobotLearningSettings, taught: Sequence[Packet], first_epoch: int
) -> OwnExamples:
    """Read the keyframes of a robot and find what it saw again.

    Args:
        folder: of the keyframes.
        settings: of the robot.
        taught: what the fleet teaches, checked; what does not fit a keyframe is left out.
        first_epoch: epoch of the first session of this start.
    """
    kept = read_keyframes(folder, settings.most_keyframes)
    version = kept[-1].detector_version if kept else ""
    shown = [(frame, picture) for frame in kept if (picture := _picture(frame, version)) is not None]
    held_out = _split(folder / SPLIT_FILE, [frame for frame, _ in shown], settings.held_out)
    trained = [each for each, is_held_out in zip(shown, held_out, strict=True) if not is_held_out]
    judged = [each for each, is_held_out in zip(shown, held_out, strict=True) if is_held_out]
    frames, poses = _keyframes(trained)
    found = revisits_in_map(frames, poses)
    pairs = [_pair(frames, poses, i, j, rows) for i, j, rows in found.pairs]
    voted = [vote(k, frames[k].features.keypoints_px, each) for k, each in enumerate(found.sightings)]
    numbers = {(first_epoch + frame.part, frame.image.keyscan): number for number, (frame, _) in enumerate(trained)}
    images = []
    for packet in taught:
        body = packet.body
        if isinstance(body, TaughtPlace) and body.detector_version == version:
            number = numbers.get((packet.epoch, body.number))
            image = None if number is None else _taught(frames[number], trained[number][0], number, body)
            images += [] if image is None else [image]
    votes = [each for each in voted if each is not None]
    examples = RevisitExamples([frame.image for frame in frames], pairs, images, votes)
    return OwnExamples(examples, HeldOutPairs.of(*_keyframes(judged)))


def _picture(frame: KeptKeyframe, version: str) -> GreyImage | None:
    """The image of a keyframe that the present detector described, in whole cells; None for another one, or if it is
    broken."""
    picture = decode_grey(frame.image.encoded) if frame.detector_version == version else None
    return None if picture is None else padded(picture)


def _split(path: Path, frames: Sequence[KeptKeyframe], settings: HeldOutSettings) -> list[bool]:
    """Which keyframes are held out; what was decided once stays, wherever the map moves."""
    known: dict[str, bool] = {}
    with suppress(OSError, ValueError, AttributeError):
        known = {str(name): bool(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
    names = [f"{frame.part}-{frame.image.keyscan}" for frame in frames]
    for name, frame in zip(names, frames, strict=True):
        known.setdefault(name, settings.is_held_out(frame.T_own_base))
    write_file(path, json.dumps(known))
    return [known[name] for name in names]


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


def _taught(frame: Keyframe, kept: KeptKeyframe, number: int, taught: TaughtPlace) -> TaughtImage | None:
    """The taught codes at the pixels of their keypoints; None if they are few, or of another place."""
    rows = np.flatnonzero(frame.placed)[: taught.count]
    if len(rows) < taught.count or len(taught.rows) < FEWEST_SHARED:
        return None
    # The place was sent in the coordinates of its keyscan, rounded and sorted by position.
    sent = frame.positions[rows]
    sent[:, :2] = se2.transform(kept.image.T_keyscan_image, sent[:, :2])
    chosen = rows[ascending(quantise_keypoints(sent.astype(np.float32)))][taught.rows]
    positions = _in_map(frame, kept.T_own_base)[chosen]
    return TaughtImage(number, frame.features.keypoints_px[chosen], taught.codes, positions)
