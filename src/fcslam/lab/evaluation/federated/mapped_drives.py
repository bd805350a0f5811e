"""Training data from a mission: the robots' keyframes at their estimated poses, and the accepted closures.

Images and LiDAR returns stay on the robots. The study has them all in one process and takes from them only what each
robot, or the cloud, would have.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from fcslam.features.detector import FeatureDetector, decode_grey
from fcslam.geometry import se2
from fcslam.learning.revisits import Keyframe
from fcslam.mission.driving import legs
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import ClosureStatus, FloatArray
from fcslam.robot.backend import BackendInput, RobotBackend, SessionEnd
from fcslam.robot.beside import Inline
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.image_buffer import KeyframeImage
from fcslam.runs import Run
from fcslam.sources import Source
from fcslam.wire.messages import Body

REACH_M = 3.0
"""Keyframes this close to an end of a closure belong to it: their motion to it is hardly off."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedDrive:
    """The keyframes of one robot in a mission."""

    robot: str
    keyframes: tuple[Keyframe, ...]
    stamps: FloatArray
    """Stamps of the keyframes' keyscans, shape (N,), seconds."""
    T_own_base: FloatArray
    """Estimated poses at the keyframes in the robot's own map, shape (N, 3), metres and radians."""
    T_map_base: FloatArray
    """The same in the fleet's map, shape (N, 3)."""
    map_index: int
    """Index of the fleet's map that the robot is in."""


@dataclass(frozen=True, slots=True)
class Tie:
    """Two keyframes that an accepted closure connects, and the estimated pose of the second base in the first, (3,)."""

    robot_i: str
    i: int
    robot_j: str
    j: int
    T_i_j: FloatArray


def map_drives(
    sources: Sequence[Source], config: MissionConfig, detector: FeatureDetector
) -> tuple[dict[str, MappedDrive], Run]:
    """Map recordings together and keep what their robots know.

    Args:
        sources: the recordings, one robot each; only the first session of a robot counts.
        config: of the mission.
        detector: describes the keyframes.
    """
    runners = {source.name: _Keeping(RobotBackend(source.name, config.robot)) for source in sources}
    fronts = {name: RobotFrontend(name, config.robot, runner) for name, runner in runners.items()}
    run = run_mission(
        sources, config, drive=lambda given, _: nullcontext([legs(source, fronts[source.name]) for source in given])
    )
    return {name: _drive(fronts[name], runner.kept, run, detector) for name, runner in runners.items()}, run


def ties(drives: dict[str, MappedDrive], run: Run) -> Iterator[Tie]:
    """Pairs of keyframes of two robots near both ends of an accepted closure between them, each once.

    Their relative poses are those of the fleet's map.
    """
    seen: set[tuple[str, int, str, int]] = set()
    for closure in run.closures:
        names = closure.robot_i, closure.robot_j
        if closure.status is not ClosureStatus.ACCEPTED or names[0] == names[1] or not set(names) <= drives.keys():
            continue
        a, b = (drives[name] for name in names)
        if a.map_index != b.map_index:
            continue
        for i in _near(a, closure.stamp_i):
            for j in _near(b, closure.stamp_j):
                key = min((names[0], i, names[1], j), (names[1], j, names[0], i))
                if key not in seen:
                    seen.add(key)
                    first, second = (drives[name].T_map_base[k] for name, k in (key[:2], key[2:]))
                    yield Tie(*key, se2.between(first, second))


class _Keeping(Inline):
    """A back end whose keyframes are kept beyond the end of its first session."""

    def __init__(self, backend: RobotBackend) -> None:
        super().__init__(backend)
        self._backend = backend
        self.kept: tuple[KeyframeImage, ...] | None = None

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """As the back end does."""
        if isinstance(input, SessionEnd) and self.kept is None:
            self.kept = self._backend.keyframes
        return super().submit(input)


def _drive(
    front: RobotFrontend, kept: tuple[KeyframeImage, ...] | None, run: Run, detector: FeatureDetector
) -> MappedDrive:
    """Put the keyframes of a robot on the poses of their keyscans."""
    track, own, fleet = front.tracks[0], run.local_maps[front.robot], run.trajectories[front.robot]
    numbers = track.keyscans
    firsts = np.searchsorted(numbers, np.arange(numbers.max(initial=-1) + 1))
    keyframes, scans, offsets = [], [], []
    for image in kept or ():
        picture = decode_grey(image.encoded)
        if picture is not None:
            keyframes.append(Keyframe.of(picture, detector.detect(picture), image.camera, image.surroundings))
            scans.append(int(firsts[image.keyscan]))
            offsets.append(image.T_keyscan_image)
    moved = np.array(offsets).reshape(-1, 3)
    return MappedDrive(
        front.robot, tuple(keyframes), fleet.stamps[scans], se2.compose(own.T_local_base[scans], moved),
        se2.compose(fleet.T_map_base[scans], moved), fleet.map_index,
    )  # fmt: skip


def _near(drive: MappedDrive, stamp: float) -> list[int]:
    """Keyframes within ``REACH_M`` of the one at the stamp, by the robot's own map, and close to it in time."""
    if not len(drive.stamps):
        return []
    here = int(np.argmin(np.abs(drive.stamps - stamp)))
    gaps_m = np.hypot(*(drive.T_own_base[:, :2] - drive.T_own_base[here, :2]).T)
    near, low, high = gaps_m <= REACH_M, here, here
    while low > 0 and near[low - 1]:
        low -= 1
    while high + 1 < len(near) and near[high + 1]:
        high += 1
    return list(range(low, high + 1))
