"""Training data from a mission: the robots' keyframes at their estimated poses.

Images and LiDAR returns stay on the robots. The study has them all in one process and takes from them only what each
robot, or the cloud, would have.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from fcslam.cloud.report import Track
from fcslam.features.detector import FeatureDetector, decode_grey
from fcslam.geometry import se2
from fcslam.learning.revisits import Keyframe
from fcslam.mission.driving import Leg, legs
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import FloatArray
from fcslam.robot.backend import BackendInput, RobotBackend, Task
from fcslam.robot.backend_runner import inline
from fcslam.robot.keyframe_folder import KeyframeImage
from fcslam.runs import Run
from fcslam.sources import Source
from fcslam.wire.messages import Body


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


def map_drives(sources: Sequence[Source], config: MissionConfig, detector: FeatureDetector) -> dict[str, MappedDrive]:
    """Map recordings together and keep what their robots know.

    Args:
        sources: the recordings, one robot each; only the first session of a robot counts.
        config: of the mission.
        detector: describes the keyframes.
    """
    runners = {source.name: _Keeping(RobotBackend(source.name, config.robot)) for source in sources}
    tracks: dict[str, Track] = {}

    def noted(source: Source) -> Iterator[Leg]:
        for leg in legs(source, config.robot, runners[source.name].submit):
            tracks.update(leg.tracks)
            yield leg

    run = run_mission(sources, config, drive=lambda given, _: nullcontext([noted(source) for source in given]))
    return {name: _drive(name, tracks[name], runner.kept, run, detector) for name, runner in runners.items()}


class _Keeping:
    """A back end whose keyframes are kept beyond the end of its first session."""

    def __init__(self, backend: RobotBackend) -> None:
        self._backend, self._submit = backend, inline(backend)
        self.kept: tuple[KeyframeImage, ...] | None = None

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """As the back end does."""
        if input is Task.END_SESSION and self.kept is None:
            self.kept = self._backend.views.keyframes
        return self._submit(input)


def _drive(
    robot: str, track: Track, kept: tuple[KeyframeImage, ...] | None, run: Run, detector: FeatureDetector
) -> MappedDrive:
    """Put the keyframes of a robot on the poses of their keyscans."""
    own, fleet = run.local_maps[robot], run.trajectories[robot]
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
        robot,
        tuple(keyframes),
        fleet.stamps[scans],
        se2.compose(own.T_local_base[scans], moved),
        se2.compose(fleet.T_map_base[scans], moved),
        fleet.map_index,
    )
