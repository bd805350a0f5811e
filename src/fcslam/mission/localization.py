"""Localization of one recorded robot in a finished map: a recording and a map in, believed poses out.

sources -> robot (LiDAR tracking) -> localization in the map -> run folder
"""

import csv
import os
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fcslam.config import dump, one_line
from fcslam.errors import InputError, SourceError
from fcslam.geometry.groups import SE2, SE3, Group, group_of
from fcslam.lidar.frozen_map import frozen_map
from fcslam.lidar.occupancy import Casting, draw_over
from fcslam.maps.drawing import map_png
from fcslam.maps.joint_voxels import read_points
from fcslam.maps.occupancy_map import OccupancyMap, map_stem, parse_map, server_files
from fcslam.maps.ros_map import read_ros_map
from fcslam.mission.driving import SCANS_PER_LEG, front_end_of
from fcslam.mission.mission import MissionConfig, MissionInputs, continued_config, run_mission
from fcslam.mission.mission_file import is_mission, read_mission
from fcslam.records import FloatArray, LaserScan, checked_pose, frozen
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.map_localizer import MapEstimate, MapLocalizer
from fcslam.runs import LocalizedPoses, Metric, RobotTrajectory, Run
from fcslam.runs.folder import MISSION, ROBOTS
from fcslam.runs.tables import read_robots
from fcslam.sources import Source
from fcslam.untrusted import read_bytes

if TYPE_CHECKING:
    from fcslam.robot.frontend3d import RobotFrontend3d

MAP_YAML: Final = "map.yaml"
"""The first map of a run folder."""
UPDATE_STEP_M: Final = 0.1
"""Least distance between two scans that are drawn into a finished map."""
_BESIDE: Final = 5
"""Numbers of one scan beside its pose: stamp, standard deviations, quality."""


@dataclass(frozen=True, slots=True)
class LocalizationProgress:
    """Progress of a localization."""

    scans: int
    is_localized: bool
    quality: float
    """Quality of the newest pose; 0 where the robot is not localized."""


class FinishedMap(NamedTuple):
    """A map in which robots are localized."""

    occupancy: OccupancyMap
    ply: bytes = b""
    """Its points in space; none of a map in the plane."""


def read_map(path: Path, floor: str = "") -> OccupancyMap:
    """As ``read_finished``, without points."""
    return read_finished(path, floor).occupancy


def read_finished(path: Path, floor: str = "") -> FinishedMap:
    """Read the first map of a floor from a run folder, a mission file or a map of ROS. fcslam maps the packets of a
    mission file. A map of ROS is a YAML file of map_server and the image that it names.

    Name the floor where the run has several, because they may look the same.
    """
    if path.suffix == Path(MISSION).suffix or (os.path.isfile(path) and is_mission(path)):
        return _mission_map(path, floor)
    if os.path.isfile(path / ROBOTS):
        number, floor = _map_on(floor, _floors(path), path)
        points = path / f"{map_stem(number)}.ply"
        occupancy = replace(read_ros_map(path / f"{map_stem(number)}.yaml"), floor=floor)
        return FinishedMap(occupancy, read_bytes(points, path) if points.exists() else b"")
    if floor:
        raise SourceError(f"{path}: only run folders and mission files know floors; leave the floor out")
    return FinishedMap(read_ros_map(path / MAP_YAML if os.path.isdir(path) else path))


def pose_in_map(name: str, given: ArrayLike, occupancy: OccupancyMap) -> FloatArray:
    """A pose (x, y, theta) within the map, metres and radians, shape (3,); ``name`` is what messages call it."""
    pose = checked_pose(name, given)
    low = np.array(occupancy.origin_xy)
    high = low + occupancy.resolution_m * np.array(occupancy.cells.shape[::-1])
    if not ((low <= pose[:2]) & (pose[:2] <= high)).all():
        raise InputError(
            f"{name}: ({pose[0]:.6g} m, {pose[1]:.6g} m) is outside of the map, which extends from "
            f"({low[0]:.1f} m, {low[1]:.1f} m) to ({high[0]:.1f} m, {high[1]:.1f} m)"
        )
    return pose


def _floors(folder: Path) -> dict[int, str]:
    try:
        return dict(read_robots(folder / ROBOTS, folder).values())
    except (OSError, ValueError, csv.Error) as error:
        raise SourceError(f"{folder}: a damaged run folder ({one_line(str(error))})") from error


def _map_on(floor: str, floors: Mapping[int, str], path: Path) -> tuple[int, str]:
    """Number and floor of the first map on a floor; without ``floor``, on the only one."""
    known = set(floors.values())
    listed = ", ".join(its or "one without a name" for its in sorted(known))
    if not floor and len(known) > 1:
        raise SourceError(f"{path}: has maps of several floors ({listed}); name the robot's floor (--floor)")
    if floor and floor not in known:
        raise SourceError(f"{path}: has no map of floor {floor!r}; its floors: {listed}")
    number = min((k for k, its in floors.items() if its == floor or not floor), default=0)
    return number, floors.get(number, "")


def run_localization(
    source: Source,
    finished: FinishedMap,
    config: MissionConfig,
    initial: FloatArray | None = None,
    progress: Callable[[LocalizationProgress], None] = lambda _: None,
    update: bool = False,
) -> Run:
    """Localize a robot in a map, as ``fcslam.localize`` does; ``initial`` is its ``initial_pose``, shape (3,).

    ``progress`` is called every ``SCANS_PER_LEG`` scans.
    """
    occupancy = finished.occupancy
    localizer = MapLocalizer(frozen_map(occupancy, "the map"), initial)
    records = source.records()
    first = list(islice(records, 1))
    robot = front_end_of(source.name, config.robot, first, localizer.submit)
    drive, in_space = LocalizedDrive(), None
    if finished.ply:
        from fcslam.robot.space_localizer import SpaceLocalizer, SpaceMap  # robots in the plane need no surfaces

        space = SpaceMap(*read_points(finished.ply, "the map"))
        if isinstance(robot, RobotFrontend):
            drive = LocalizedDrive(SE3, space.on_floor)
        else:
            drive, in_space = LocalizedDrive(SE3), SpaceLocalizer(robot, localizer, space)
    if update and not isinstance(robot, RobotFrontend):
        raise InputError(f"{source.name}: has clouds of a 3D LiDAR; only scans of a 2D laser update a map")
    scans: dict[float, LaserScan] = {}
    for record in chain(first, records):
        if update and isinstance(record, LaserScan):
            scans[record.stamp] = record
        # 1. Track the scan; the localizer follows with the keyscans.
        packets = robot.process(record)
        if in_space is not None:
            in_space.follow(packets)
        # 2. Place the new scans in the map.
        before = len(drive)
        _place(robot, (in_space or localizer).estimate, drive)
        if len(drive) // SCANS_PER_LEG > before // SCANS_PER_LEG:
            progress(LocalizationProgress(len(drive), localizer.estimate is not None, drive.quality))
    losses = localizer.losses  # without the end of the recording
    robot.finish()
    _place(robot, (in_space or localizer).estimate, drive)
    run = drive.run(source.name, finished, config, localizer.fixes, losses)
    return _updated(run, occupancy, scans, drive.poses(source.name), config) if update else run


def _updated(
    run: Run, occupancy: OccupancyMap, scans: Mapping[float, LaserScan], poses: LocalizedPoses, config: MissionConfig
) -> Run:
    """The run with the scans drawn into its map; a scan counts if the robot moved since the one before it."""
    seen: list[Casting] = []
    for stamp, pose, is_localized in zip(poses.stamps.tolist(), poses.T_map_base, poses.is_localized, strict=True):
        if not is_localized or stamp not in scans:
            continue
        if seen and np.hypot(*(pose - seen[-1].T_map_base)[:2]) < UPDATE_STEP_M:
            continue
        seen.append(Casting(scans[stamp].ranges_m, scans[stamp].laser, pose, scans[stamp].sweep))
    updated = draw_over(occupancy, seen, config.map)
    files = _map_files(updated, poses.believed())
    return replace(run, map_files={**run.map_files, **files} | server_files("map_before", occupancy))


def _map_files(occupancy: OccupancyMap, path: RobotTrajectory) -> dict[str, bytes]:
    return {**server_files("map", occupancy), "map.png": map_png(occupancy, {path.robot: path.T_map_base})}


class LocalizedDrive:
    """The poses of one robot in a finished map, scan by scan. It grows by 64 bytes a scan in the plane."""

    def __init__(self, group: Group = SE2, lifted: Callable[[FloatArray], FloatArray] = lambda pose: pose) -> None:
        """``group`` is that of the map, and ``lifted`` makes its pose of one that estimates give."""
        self._rows = array("d")
        self._first_m = np.nan
        self._group, self._lifted, self._row = group, lifted, group.size + _BESIDE
        self.session, self.begun = 0, 0
        """Number of the present session from 1, and the number of scans before it."""

    def __len__(self) -> int:
        return len(self._rows) // self._row

    @property
    def quality(self) -> float:
        """Quality of the newest pose; 0 without one."""
        return self._rows[-1] if self._rows else 0.0

    def add(self, stamp: float, travel_m: float, T_odom_base: FloatArray, estimate: MapEstimate | None) -> None:
        """Append the next scan, after a path of ``travel_m``, at a pose in the session's ``odom``, shape (P,).

        ``estimate``: where that lies in the map; None: the robot is not localized.
        """
        if estimate is None:
            self._rows.extend((stamp, *(self._row - 2) * (np.nan,), 0.0))
            return
        if np.isnan(self._first_m):
            self._first_m = travel_m
        T_map_base = self._lifted(group_of(T_odom_base).compose(estimate.T_map_odom, T_odom_base))
        self._rows.extend((stamp, *T_map_base, *np.sqrt(np.diag(estimate.covariance)), estimate.quality))

    def poses(self, robot: str) -> LocalizedPoses:
        """The poses so far of a robot of this name."""
        rows = np.array(self._rows).reshape(-1, self._row)
        stamps, T_map_base, sigma, quality = rows[:, 0], rows[:, 1:-4], rows[:, -4:-1], rows[:, -1]
        planar = self._group.to_plane(T_map_base)
        in_space: FloatArray | None = None if self._group is SE2 else frozen(T_map_base)
        return LocalizedPoses(robot, frozen(stamps), frozen(planar), frozen(sigma), frozen(quality), in_space)

    def run(self, robot: str, finished: FinishedMap, config: MissionConfig, fixes: int, losses: int) -> Run:
        """The run folder of the drive: believed poses, every scan, and the map.

        ``fixes``: how often the robot was found; ``losses``: how often it was localized and then was not.
        """
        poses = self.poses(robot)
        believed = poses.believed()
        metrics = (
            Metric("scans", len(self), "1"),
            Metric("localized_share", float(poses.is_localized.mean()) if len(self) else 0.0, "1"),
            Metric("first_fix_after", self._first_m, "m"),
            Metric("fixes", fixes, "1"),
            Metric("losses", losses, "1"),
        )
        return Run(
            trajectories={robot: replace(believed, floor=finished.occupancy.floor)},
            metrics={metric.name: metric for metric in metrics},
            config_yaml=dump(config),
            map_files=_map_files(finished.occupancy, believed) | ({"map.ply": finished.ply} if finished.ply else {}),
            localized={robot: poses},
        )


def _place(robot: "RobotFrontend | RobotFrontend3d", estimate: MapEstimate | None, drive: LocalizedDrive) -> None:
    track = robot.scan_poses
    if drive.session != len(robot.tracks):
        drive.session, drive.begun = len(robot.tracks), len(drive)
    for number in range(len(drive) - drive.begun, len(track)):
        drive.add(track[number].stamp, robot.travel_m, track.in_odom(track[number]), estimate)


def _mission_map(path: Path, floor: str) -> FinishedMap:
    saved = read_mission(path)
    run = run_mission((), continued_config(saved), inputs=MissionInputs(saved))
    floors = {trajectory.map_index: trajectory.floor for trajectory in run.trajectories.values()}
    number, floor = _map_on(floor, floors, path)
    files, stem = run.map_files, map_stem(number)
    if f"{stem}.yaml" not in files:
        raise SourceError(f"{path}: the mission has no map; no robot has sent a keyscan")
    occupancy = parse_map(str(path), files[f"{stem}.pgm"], files[f"{stem}.yaml"].decode())
    return FinishedMap(replace(occupancy, floor=floor), files.get(f"{stem}.ply", b""))
