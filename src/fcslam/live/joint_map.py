"""The joint map of the fleet on one robot, with what the robot saw lately drawn into it."""

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.geometry.groups import group_of
from fcslam.lidar.occupancy import Casting, OccupancyConfig, draw_over
from fcslam.lidar.scan import rays_of
from fcslam.live.fleet_view import FleetView
from fcslam.live.map_poses import CorrectedOdometry
from fcslam.live.records import RobotPose
from fcslam.maps.joint_tiles import padded
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.maps.teammates import returns_near
from fcslam.records import FloatArray, Keyscan, LaserModel, LaserScan, without
from fcslam.robot.track import ScanTrack
from fcslam.warmup import made_up_scans
from fcslam.wire.messages import Hello, Packet

OLDEST_S = 2.0
"""An older pose does not say where a robot is now."""
SPEED_MPS = 0.5
"""By how much the place of a robot grows with the age of its pose."""
WALL_CELLS = 2
"""A point so few cells from an occupied cell is of that wall."""
FREE, OCCUPIED = int(Occupancy.FREE), int(Occupancy.OCCUPIED)
MOST_DRAWN = 20_000
"""Most keyscans that wait to be drawn by the cloud: hours of an outage."""
MOST_MET = 1000
"""Scans that saw other robots and may become keyscans yet."""


_ScanKey = tuple[float, tuple[float, float, float], int]


def _key(stamp: float, laser: LaserModel) -> _ScanKey:
    return stamp, laser.T_base_laser, laser.beam_count


class JointMap:
    """What a robot makes of the joint map of its fleet. ``draw`` may be called from any thread, the others from one."""

    def __init__(self, fleet: FleetView, config: OccupancyConfig) -> None:
        self._fleet, self._config = fleet, config
        self._drawn: deque[tuple[int, Keyscan, LaserModel]] = deque(maxlen=MOST_DRAWN)
        """Session and laser of keyscans that the joint map may not show yet, without returns from other robots."""
        self._lasers: tuple[LaserModel, ...] = ()
        """As the robot announced them last."""
        self._newest: tuple[int, FloatArray] | None = None
        """Session of the newest scan, and its pose by odometry without its jumps, or by the prediction in its place."""
        self._met: dict[_ScanKey, NDArray[np.bool_]] = {}
        """Beams of the newest scans that hit other robots."""
        self._lock = threading.Lock()
        (scan,), cell = made_up_scans(1), OccupancyMap(np.zeros((1, 1), np.uint8), 1.0, (0.0, 0.0))
        here = scan.T_odom_base
        beams_on_teammates(scan, here, here, here[None] * (1.0, 1.0, 0.0), cell, 1.0)  # no scan waits for the compiler

    def add(self, packets: Iterable[Packet]) -> None:
        """Keep the next keyscans until the cloud has drawn them."""
        for packet in packets:
            keyscan = packet.body
            if isinstance(keyscan, Hello):
                self._lasers = keyscan.lasers
            elif isinstance(keyscan, Keyscan):
                laser = keyscan.laser_model(self._lasers)
                ranges_m = without(keyscan.ranges_m, self._met.pop(_key(keyscan.stamp, laser), None))
                with self._lock:
                    self._drawn.append((packet.epoch, replace(keyscan, ranges_m=ranges_m), laser))

    def draw(self, session: int, track: ScanTrack, localizer: CorrectedOdometry) -> OccupancyMap | None:
        """The joint map, with the keyscans of a session of the robot drawn into it that the cloud has not drawn yet.

        None: the server has not drawn the map that the robot's poses are in.
        """
        fleet, joint = self._fleet, self._fleet.joint_map
        if joint is None or fleet.map_index is None or fleet.map_index != localizer.map_index:
            return None
        with self._lock:
            while self._drawn and self._drawn[0][1].stamp <= fleet.drawn_s:
                self._drawn.popleft()
            waiting = [(keyscan, laser) for its_session, keyscan, laser in self._drawn if its_session == session]
        lately = [
            Casting(keyscan.ranges_m, laser, group_of(moved).to_plane(moved), keyscan.sweep)
            for keyscan, laser in waiting
            if (moved := localizer.T_map_base(track.keyscan_in_odom(keyscan.id.number))) is not None
        ]
        return padded(draw_over(joint, lately, self._config))

    def mark_teammates(self, scan: LaserScan, session: int, newest: RobotPose | None) -> LaserScan:
        """The next scan with the beams marked that hit other robots.

        ``newest`` is the pose of the previous scan. ``odom`` is another frame in each session.
        """
        fleet, radius_m = self._fleet, self._config.robot_radius_m
        before, self._newest = self._newest, (session, scan.T_odom_base)
        joint = fleet.joint_map
        if joint is None or newest is None or before is None or before[0] != session or radius_m <= 0.0:
            return scan
        if fleet.map_index != newest.map_index:  # the joint map is that of the fleet
            return scan
        places = fleet.teammates(newest.map_index)
        on_teammates = beams_on_teammates(scan, newest.T_map_base, before[1], places, joint, radius_m)
        if on_teammates is None:
            return scan
        self._met[_key(scan.stamp, scan.laser)] = on_teammates
        while len(self._met) > MOST_MET:
            del self._met[next(iter(self._met))]
        return replace(scan, on_teammates=on_teammates)


def beams_on_teammates(
    scan: LaserScan,
    T_map_before: FloatArray,
    T_odom_before: FloatArray,
    places: FloatArray,
    joint: OccupancyMap,
    radius_m: float,
) -> NDArray[np.bool_] | None:
    """Which beams hit another robot, shape (beam_count,); None if none does: scans must not be matched by them.

    A robot that drives along with this one would look like a wall that stands still. The points stay in the scan:
    whether the map shows them is decided where the scans of all robots are known (``fcslam.maps.teammates``).

    A pose alone takes no point away, as it may be false. A point counts only if the joint map says that the floor is
    free there, and no wall is near it. So nobody hides a wall of the map. What is new on that floor, such as a closed
    door, does not count while a robot says that it is there.

    Args:
        scan: the scan; its odometry says how far the robot drove since the previous scan.
        T_map_before: where the previous scan was made, in the frame of ``joint``, shape (3,).
        T_odom_before: its odometry, shape (3,).
        places: of the other robots in that map: x, y and the age of their poses, shape (N, 3), metres and seconds.
        joint, radius_m: the joint map, and the radius of a robot.
    """
    T_map_base = se2.compose(T_map_before, se2.between(T_odom_before, scan.T_odom_base))
    limits_m = radius_m + SPEED_MPS * places[:, 2]
    apart_m = np.hypot(*(places[:, :2] - T_map_base[:2]).T)
    near = (places[:, 2] <= OLDEST_S) & (apart_m <= scan.laser.max_range_m + limits_m)
    if not near.any():
        return None
    rays, reach_m = rays_of(scan.laser, scan.sweep), scan.laser.max_range_m
    found = np.zeros(scan.laser.beam_count, np.bool_)
    for place, limit_m in zip(places[near, :2], limits_m[near], strict=True):
        hit, points = returns_near(scan.ranges_m, *rays, reach_m, T_map_base, place, place, limit_m)
        found[hit] = _are_on_floor(points, joint.cells, joint.origin_xy, joint.resolution_m)
    return found if found.any() else None


@njit
def _are_on_floor(points, cells, origin_xy, side_m):  # type: ignore[no-untyped-def]
    """Whether points of a map, shape (N, 2), lie in a free cell without a wall beside it, shape (N,)."""
    result = np.zeros(len(points), np.bool_)
    height, width = cells.shape
    for i in range(len(points)):
        column = int(np.floor((points[i, 0] - origin_xy[0]) / side_m))
        row = int(np.floor((points[i, 1] - origin_xy[1]) / side_m))
        if not (0 <= row < height and 0 <= column < width):
            continue
        result[i] = cells[row, column] == FREE
        for r in range(max(0, row - WALL_CELLS), min(height, row + WALL_CELLS + 1)):
            for c in range(max(0, column - WALL_CELLS), min(width, column + WALL_CELLS + 1)):
                result[i] &= cells[r, c] != OCCUPIED
    return result
