"""The front end of a robot with a 3D LiDAR: turns of the LiDAR in, packets out. It knows no network.

Packets are those of a robot with a 2D laser, with motions in six degrees of freedom and local maps in voxels. What a
2D laser would see above the floor makes its keyscans.
"""

import math
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fcslam.errors import FeatureError
from fcslam.features.birdseye import DETECTOR_VERSION, describe
from fcslam.geometry import se3
from fcslam.geometry.groups import SE3
from fcslam.lidar.frontend import ScanPose
from fcslam.lidar.lost import has_moved_unseen
from fcslam.lidar3d.ground import levelled, seen_by
from fcslam.lidar3d.local_maps import KeyframeMotion, Keyframes, MappedTurn, SurfaceMap, SurfaceMaps, wall_columns
from fcslam.lidar3d.tracker import SETTLED, Tracked, Tracker3d, inverse
from fcslam.records import (
    Channel,
    CloudScan,
    Constraint,
    ConstraintKind,
    DetectorFile,
    FloatArray,
    Keyscan,
    KeyscanId,
    Place,
    Ranges,
    SensorRecord,
    frozen,
)
from fcslam.robot.backend import SessionConfig, Task
from fcslam.robot.mapped_scans import MappedScans
from fcslam.robot.packet_queue import PacketQueue
from fcslam.robot.track import ScanBelief, ScanTrack
from fcslam.robot.wheel_odometry import WheelOdometry
from fcslam.sources.clouds_in_space import BAND_LASER
from fcslam.sources.gate import MAX_STEP_BACK_S
from fcslam.wire.messages import Body, Hello, Packet
from fcslam.wire.quantisation import rounded


class NewestTurn(NamedTuple):
    """The tracker's result for the newest turn; fields as in ``NewestScan``."""

    pose: ScanPose
    tracked: Tracked
    covariance: FloatArray
    """Covariance of the motion since the last keyscan, in its tangent, shape (6, 6)."""
    quality: float = math.nan

    @property
    def is_deferred(self) -> bool:
        """Whether the surfaces explain it badly, so that it may be cut off."""
        return self.tracked.is_poor


class RobotFrontend3d:
    """Turns the sensor records of a robot into packets; the poses of all turns stay on the robot."""

    scans = CloudScan
    """As in ``RobotFrontend``."""

    def __init__(self, robot: str, config: SessionConfig, floor: str = "") -> None:
        """Start the first session, on ``floor``; empty: it has no name."""
        self.robot = robot
        self.tracks: list[ScanTrack] = []
        """Poses of the turns, by session."""
        self.odometry = WheelOdometry()
        self.newest: NewestTurn | None = None
        """The newest turn; None before the first."""
        self.mapped: tuple[MappedTurn, FloatArray] | None = None
        """The newest keyframe, and ``T_odom_ground`` there, shape (7,); None before the first."""
        self.lacks_odometry = True
        self._describes = Channel.LIDAR in config.channels
        self._mapped_scans = MappedScans(config.lidar.ignore, config.lidar.footprint)
        self.packets = PacketQueue(robot, _passed_on)
        self._before: CloudScan | None = None
        """The newest turn; None if the next one is of another place."""
        self._begin(ScanTrack(floor, is_new_floor=True, group=SE3))

    @property
    def scan_poses(self) -> ScanTrack:
        """Poses of the turns of the present session."""
        return self.tracks[-1]

    @property
    def jumps(self) -> int:
        """As in ``RobotFrontend``."""
        return self.odometry.jumps

    @property
    def odometry_fault(self) -> str | None:
        """As in ``RobotFrontend``; None once it says something again."""
        return self.odometry.check.fault if self.lacks_odometry else None

    @property
    def travel_m(self) -> float:
        """Path length of the present session up to its newest keyframe, metres."""
        return 0.0 if self._keyframes.newest is None else self._keyframes.newest.travel_m

    @property
    def belief(self) -> ScanBelief:
        """Pose and covariance of the newest turn."""
        assert self.newest is not None
        return ScanBelief(self.newest.tracked.measured, partial(np.array, self.newest.covariance))

    def set_detector(self, file: DetectorFile, path: Path) -> Future[list[Body]]:  # noqa: ARG002
        """As in ``RobotFrontend``; a robot without a camera takes none."""
        refused: Future[list[Body]] = Future()
        refused.set_exception(FeatureError("a robot with a 3D LiDAR uses no camera"))
        return refused

    def place_keyframes(self) -> None:
        """As in ``RobotFrontend``: there are no images."""

    def process(self, record: SensorRecord) -> list[Packet]:
        """Process the next record of the recording; returns the packets that are ready."""
        if isinstance(record, CloudScan):
            record = self.odometry.place_cloud(self._mapped_scans.cloud(record))
            if self._before is not None and _is_unconnected(self._before, record):
                self.begin_session()
            if record.new_floor:
                self.change_floor(record.new_floor)
            self._before = record
            self._track(record)
        return self.ready()

    def ready(self, wait: bool = False) -> list[Packet]:
        """The next packets."""
        return self.packets.ready(wait)

    def begin_session(self) -> None:
        """End the present session and begin another: the next turn is of another place."""
        if len(self.scan_poses):
            self._end_session()
            self._begin(ScanTrack(self.scan_poses.floor, group=SE3))

    def change_floor(self, floor: str) -> None:
        """Go on in a new session on another floor; empty: without a name."""
        if floor != self.scan_poses.floor:
            self.begin_session()
            self.scan_poses.floor, self.scan_poses.is_new_floor = floor, True

    def finish(self) -> list[Packet]:
        """End the recording; returns all packets that are left."""
        self._end_session()
        return self.ready()

    def _begin(self, track: ScanTrack) -> None:
        self.tracks.append(track)
        self._tracker, self._keyframes, self._local_maps = Tracker3d(), Keyframes(), SurfaceMaps()
        self._poor: list[Tracked] = []
        """The newest turns, if the surfaces explain them badly."""
        self._certain_s = -np.inf
        self._before = None

    def _track(self, scan: CloudScan) -> None:
        tracked = self._tracker.track(scan)
        self.lacks_odometry = not len(scan.wheels)
        self._poor = [*self._poor, tracked] if tracked.is_poor else []
        if len(self._poor) > SETTLED:
            if self._local_maps.show_place_of(self._poor):
                self._tracker.accept(self._poor)
                self._poor = []
            else:  # the surfaces do not explain where it is any more
                self.scan_poses.cut(self._certain_s)
                self.begin_session()
                self._before = scan
                tracked = self._tracker.track(scan)
        if not self._poor:
            self._certain_s = scan.stamp
        self.packets.advance(scan.stamp)
        keyframe, motion = self._keyframes.add(tracked, scan.imu[:, 4:].mean(axis=0) if len(scan.imu) else None)
        newest = self._keyframes.newest
        assert newest is not None  # the first turn of a session is a keyframe
        if keyframe is not None:
            self._map(keyframe, motion, scan.stamp)
        T_keyframe_base = se3.between(newest.T_odom_base, tracked.T_odom_base)
        pose = ScanPose(scan.stamp, newest.number, T_keyframe_base)
        self.scan_poses.add(pose)
        covariance = self._keyframes.covariance if motion is None else inverse(motion.information)
        self.newest = NewestTurn(pose, tracked, covariance)

    def _map(self, keyframe: MappedTurn, motion: KeyframeMotion | None, stamp: float) -> None:
        local_map = self._local_maps.add(keyframe)
        if motion is None:
            versions = {Channel.LIDAR: DETECTOR_VERSION} if self._describes else {}
            self._send(Hello(self.robot, len(self.tracks) - 1, (BAND_LASER,), versions))
        self._send(Keyscan(KeyscanId(self.robot, keyframe.number), stamp, self._band(keyframe)))
        if motion is not None:
            self.scan_poses.extend(motion.T_i_j)
            self._send(self._constraint(motion, ConstraintKind.ODOMETRY))
        if local_map is not None:
            self._send_map(local_map)

    def _band(self, keyframe: MappedTurn) -> Ranges:
        T_odom_ground = levelled(keyframe.T_odom_base, self._keyframes.vertical.up, keyframe.height_m)
        self.mapped = keyframe, T_odom_ground
        around = [
            se3.transform(se3.between(T_odom_ground, each.T_odom_base), each.points) for each in self._local_maps.recent
        ]
        return frozen(
            rounded(seen_by(BAND_LASER, around[-1], np.concatenate(around)), BAND_LASER.max_range_m), np.float32
        )

    def _send_map(self, local_map: SurfaceMap) -> None:
        for closure in self._local_maps.closures(local_map):
            self._send(self._constraint(closure, ConstraintKind.CLOSURE))
        voxels = local_map.voxel_map(self.robot, self._keyframes.vertical.up)
        self._send(voxels)
        if self._describes:
            described = describe(wall_columns(voxels))
            self._send(Place(voxels.id, Channel.LIDAR, DETECTOR_VERSION, local_map.first, local_map.last, *described))

    def _constraint(self, motion: KeyframeMotion, kind: ConstraintKind) -> Constraint:
        return Constraint(self.robot, motion.i, motion.j, kind, frozen(motion.T_i_j), frozen(motion.information))

    def _end_session(self) -> None:
        rest = self._local_maps.finish()
        if rest is not None:
            self._send_map(rest)
        self._send(Task.END_SESSION)

    def _send(self, body: Body | Task) -> None:
        self.packets.submit(body, len(self.tracks) - 1, self.scan_poses)


def _is_unconnected(before: CloudScan, now: CloudScan) -> bool:
    """Whether nothing shows the motion between two turns."""
    gap_s = now.stamp - before.stamp
    is_gap = gap_s > MAX_STEP_BACK_S and not len(now.wheels)
    return is_gap or gap_s < -MAX_STEP_BACK_S or has_moved_unseen(before, now)


def _passed_on(body: Body | Task) -> Future[list[Body]]:
    """What the queue of packets gets back at once: there is no back end."""
    done: Future[list[Body]] = Future()
    done.set_result([] if isinstance(body, Task) else [body])
    return done
