"""The joint map of the fleet on one robot, with what the robot saw lately drawn into it."""

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.lidar.frontend import ScanPose
from fcslam.lidar.occupancy import Casting, OccupancyConfig, draw_over
from fcslam.live.fleet_view import FleetView
from fcslam.live.map_poses import CorrectedOdometry
from fcslam.live.records import RobotPose
from fcslam.live.teammates import beams_on_teammates
from fcslam.maps.joint_tiles import padded
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import FloatArray, Keyscan, LaserModel, LaserScan, without
from fcslam.robot.track import ScanTrack
from fcslam.warmup import made_up_scans
from fcslam.wire.messages import Hello, Packet

MOST_DRAWN = 20_000
"""Most keyscans that wait to be drawn by the cloud: hours of an outage."""
MOST_MET = 1000
"""Scans that saw other robots and may become keyscans yet."""


class _DrawnKeyscan(NamedTuple):
    """A keyscan that the cloud may not have drawn yet."""

    session: int
    keyscan: Keyscan
    laser: LaserModel
    on_teammates: NDArray[np.bool_] | None
    """As in ``LaserScan``."""


_ScanKey = tuple[float, tuple[float, float, float], int]


def _key(stamp: float, laser: LaserModel) -> _ScanKey:
    return stamp, laser.T_base_laser, laser.beam_count


class JointMap:
    """What a robot makes of the joint map of its fleet. ``draw`` may be called from any thread, the others from one."""

    def __init__(self, fleet: FleetView, config: OccupancyConfig) -> None:
        self._fleet, self._config = fleet, config
        self._drawn: deque[_DrawnKeyscan] = deque(maxlen=MOST_DRAWN)
        """Keyscans that the joint map of the cloud may not show yet."""
        self._lasers: tuple[LaserModel, ...] = ()
        """As the robot announced them last."""
        self._newest: tuple[int, FloatArray] | None = None
        """Session of the newest scan, and its pose by odometry without its jumps, or by the prediction in its place."""
        self._met: dict[_ScanKey, NDArray[np.bool_]] = {}
        """Beams of the newest scans that hit other robots."""
        self._lock = threading.Lock()
        (scan,), here, cell = made_up_scans(1), se2.IDENTITY, OccupancyMap(np.zeros((1, 1), np.uint8), 0.05, (0.0, 0.0))
        beams_on_teammates(scan, here, here, np.zeros((1, 3)), 0.0, cell, 0.5)  # no scan waits for the compiler

    def add(self, packets: Iterable[Packet]) -> None:
        """Keep the next keyscans until the cloud has drawn them."""
        for packet in packets:
            keyscan = packet.body
            if isinstance(keyscan, Hello):
                self._lasers = keyscan.lasers
            elif isinstance(keyscan, Keyscan):
                laser = keyscan.laser_model(self._lasers)
                on_teammates = self._met.pop(_key(keyscan.stamp, laser), None)
                with self._lock:
                    self._drawn.append(_DrawnKeyscan(packet.epoch, keyscan, laser, on_teammates))

    def draw(self, session: int, track: ScanTrack, localizer: CorrectedOdometry) -> OccupancyMap | None:
        """The joint map, with the keyscans of a session of the robot drawn into it that the cloud has not drawn yet.

        None: the server has not drawn the map that the robot's poses are in.
        """
        fleet, joint = self._fleet, self._fleet.joint_map
        if joint is None or fleet.map_index is None or fleet.map_index != localizer.map_index:
            return None
        with self._lock:
            while self._drawn and self._drawn[0].keyscan.stamp <= fleet.drawn_s:
                self._drawn.popleft()
            waiting = [one for one in self._drawn if one.session == session]
        lately = [
            Casting(ranges_m, laser, moved, keyscan.sweep)
            for _, keyscan, laser, on_teammates in waiting
            for ranges_m in [without(keyscan.ranges_m, on_teammates)]
            for T_odom_base in [track.in_odom(ScanPose(keyscan.stamp, keyscan.id.number, se2.IDENTITY))]
            if (moved := localizer.T_map_base(T_odom_base)) is not None
        ]
        return padded(draw_over(joint, lately, self._config))

    def mark_teammates(self, scan: LaserScan, session: int, newest: RobotPose | None) -> LaserScan:
        """The next scan with the beams marked that hit other robots.

        ``newest`` is the pose of the scan before. ``odom`` is another frame in each session.
        """
        fleet, radius_m = self._fleet, self._config.robot_radius_m
        before, self._newest = self._newest, (session, scan.T_odom_base)
        joint, teammates = fleet.joint_map, fleet.teammates
        if joint is None or teammates is None or newest is None or radius_m <= 0.0:
            return scan
        if before is None or before[0] != session:
            return scan
        if teammates.map_index != newest.map_index:  # the joint map is that of the teammates
            return scan
        places, since_s = teammates.places, fleet.clock() - teammates.moment_s
        on_teammates = beams_on_teammates(scan, newest.T_map_base, before[1], places, since_s, joint, radius_m)
        if on_teammates is None:
            return scan
        self._met[_key(scan.stamp, scan.laser)] = on_teammates
        while len(self._met) > MOST_MET:
            del self._met[next(iter(self._met))]
        return replace(scan, on_teammates=on_teammates)
