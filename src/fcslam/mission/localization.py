"""Localization of one recorded robot in a finished map: a recording and a map in, believed poses out.

sources -> robot (LiDAR tracking) -> localization in the map -> run folder
"""

import csv
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from fcslam.config import dump, one_line
from fcslam.errors import InputError, SourceError
from fcslam.geometry import se2
from fcslam.lidar.frozen_map import frozen_map
from fcslam.lidar.occupancy import Casting, draw_over
from fcslam.maps.drawing import map_png
from fcslam.maps.occupancy_map import OccupancyMap, map_stem, parse_map, server_files
from fcslam.maps.ros_map import read_ros_map
from fcslam.mission.mission import MissionConfig, MissionInputs, continued_config, run_mission
from fcslam.mission.mission_file import read_mission
from fcslam.records import FloatArray, LaserScan, checked_pose, frozen
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.map_localizer import MapEstimate, MapLocalizer
from fcslam.runs import LocalizedPoses, Metric, RobotTrajectory, Run
from fcslam.runs.folder import MISSION, ROBOTS
from fcslam.runs.tables import read_robots
from fcslam.sources import Source

MAP_YAML: Final = "map.yaml"
"""The first map of a run folder."""
REPORTED_SCANS: Final = 50
"""Scans between two reports of progress."""
UPDATE_STEP_M: Final = 0.1
"""Least distance between two scans that are drawn into a finished map."""
_ROW: Final = 8
"""Numbers of one scan: stamp, pose, standard deviations, quality."""


@dataclass(frozen=True, slots=True)
class LocalizationProgress:
    """Progress of a localization."""

    scans: int
    is_localized: bool
    quality: float
    """Quality of the newest pose; 0 where the robot is not localized."""


def read_map(path: Path, floor: str = "") -> OccupancyMap:
    """Read the first map of a floor from a run folder, a mission file or a map of ROS. fcslam maps the packets of a
    mission file. A map of ROS is a YAML file of map_server and the image that it names.

    Name the floor where the run has several, because they may look the same.
    """
    if path.suffix == Path(MISSION).suffix:
        return _mission_map(path, floor)
    if (path / ROBOTS).is_file():
        number, floor = _map_on(floor, _floors(path), path)
        return replace(read_ros_map(path / f"{map_stem(number)}.yaml"), floor=floor)
    if floor:
        raise SourceError(f"{path}: only run folders and mission files know floors; leave the floor out")
    return read_ros_map(path / MAP_YAML if path.is_dir() else path)


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
        return dict(read_robots(folder / ROBOTS).values())
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
    occupancy: OccupancyMap,
    config: MissionConfig,
    initial: FloatArray | None = None,
    progress: Callable[[LocalizationProgress], None] = lambda _: None,
    update: bool = False,
) -> Run:
    """Localize a robot in a map, as ``fcslam.localize`` does; ``initial`` is its ``initial_pose``, shape (3,).

    ``progress`` is called every ``REPORTED_SCANS`` scans.
    """
    localizer = MapLocalizer(frozen_map(occupancy, "the map"), initial)
    robot = RobotFrontend(source.name, config.robot, localizer.submit)
    drive = LocalizedDrive()
    scans: dict[float, LaserScan] = {}
    for record in source.records():
        if update and isinstance(record, LaserScan):
            scans[record.stamp] = record
        # 1. Track the scan; the localizer follows with the keyscans.
        robot.process(record)
        # 2. Place the new scans in the map.
        before = len(drive)
        _place(robot, localizer.estimate, drive)
        if len(drive) // REPORTED_SCANS > before // REPORTED_SCANS:
            progress(LocalizationProgress(len(drive), localizer.estimate is not None, drive.quality))
    losses = localizer.losses  # without the end of the recording
    robot.finish()
    _place(robot, localizer.estimate, drive)
    run = drive.run(source.name, occupancy, config, localizer.fixes, losses)
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
    return replace(run, map_files=files | server_files("map_before", occupancy))


def _map_files(occupancy: OccupancyMap, path: RobotTrajectory) -> dict[str, bytes]:
    return {**server_files("map", occupancy), "map.png": map_png(occupancy, {path.robot: path.T_map_base})}


class LocalizedDrive:
    """The poses of one robot in a finished map, scan by scan. It grows by 64 bytes a scan."""

    def __init__(self) -> None:
        self._rows = array("d")
        self._first_m = np.nan

    def __len__(self) -> int:
        return len(self._rows) // _ROW

    @property
    def quality(self) -> float:
        """Quality of the newest pose; 0 without one."""
        return self._rows[-1] if self._rows else 0.0

    def add(self, stamp: float, travel_m: float, T_odom_base: FloatArray, estimate: MapEstimate | None) -> None:
        """Append the next scan, after a path of ``travel_m``, at a pose in the session's ``odom``, shape (3,).

        ``estimate``: where that lies in the map; None: the robot is not localized.
        """
        if estimate is None:
            self._rows.extend((stamp, *6 * (np.nan,), 0.0))
            return
        if np.isnan(self._first_m):
            self._first_m = travel_m
        T_map_base = se2.compose(estimate.T_map_odom, T_odom_base)
        self._rows.extend((stamp, *T_map_base, *np.sqrt(np.diag(estimate.covariance)), estimate.quality))

    def poses(self, robot: str) -> LocalizedPoses:
        """The poses so far of a robot of this name."""
        rows = np.array(self._rows).reshape(-1, _ROW)
        stamps, T_map_base, sigma, quality = rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7]
        return LocalizedPoses(robot, frozen(stamps), frozen(T_map_base), frozen(sigma), frozen(quality))

    def run(self, robot: str, occupancy: OccupancyMap, config: MissionConfig, fixes: int, losses: int) -> Run:
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
            trajectories={robot: replace(believed, floor=occupancy.floor)},
            metrics={metric.name: metric for metric in metrics},
            config_yaml=dump(config),
            map_files=_map_files(occupancy, believed),
            localized={robot: poses},
        )


def _place(robot: RobotFrontend, estimate: MapEstimate | None, drive: LocalizedDrive) -> None:
    track = robot.scan_poses
    for number in range(len(drive) - sum(len(track) for track in robot.tracks[:-1]), len(track)):
        drive.add(track[number].stamp, robot.travel_m, track.in_odom(track[number]), estimate)


def _mission_map(path: Path, floor: str) -> OccupancyMap:
    saved = read_mission(path)
    run = run_mission((), continued_config(saved), inputs=MissionInputs(saved))
    floors = {trajectory.map_index: trajectory.floor for trajectory in run.trajectories.values()}
    number, floor = _map_on(floor, floors, path)
    files, stem = run.map_files, map_stem(number)
    if f"{stem}.yaml" not in files:
        raise SourceError(f"{path}: the mission has no map; no robot has sent a keyscan")
    return replace(parse_map(str(path), files[f"{stem}.pgm"], files[f"{stem}.yaml"].decode()), floor=floor)
