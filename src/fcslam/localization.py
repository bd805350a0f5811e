"""Localisation of one recorded robot in a finished map: a recording and a map in, believed poses out.

sources -> robot (LiDAR tracking) -> localisation in the map -> run folder
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.config import dump, one_line, parse_yaml
from fcslam.errors import EvaluationError, SourceError
from fcslam.geometry import se2
from fcslam.lidar.frozen_map import frozen_map
from fcslam.maps.drawing import map_png
from fcslam.mission import MissionConfig
from fcslam.records import FloatArray, frozen
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.map_localizer import MapEstimate, MapLocalizer
from fcslam.runs import LocalizedPoses, Metric, OccupancyMap, Run
from fcslam.runs.map_files import map_yaml, parse_map, pgm_bytes
from fcslam.sources import Source

MAP_YAML: Final = "map.yaml"
"""The first map of a run folder."""
REPORTED_SCANS: Final = 50
"""Scans between two reports of progress."""
LARGEST_FILE: Final = 1 << 30
"""Larger map files are refused, bytes."""


@dataclass(frozen=True, slots=True)
class LocalizationProgress:
    """Progress of a localisation."""

    scans: int
    is_localized: bool
    quality: float
    """Of the newest pose; 0 where the robot is not localised."""


def read_map(path: Path) -> OccupancyMap:
    """The map of a run folder (its first one), or of a YAML file of ROS map_server and the PGM file that it names.

    Raises:
        SourceError: there is no map, or it cannot be read. The image must lie in the folder of the YAML file.
    """
    description = path / MAP_YAML if path.is_dir() else path
    try:
        text = _content(description).decode("utf-8")
        image = parse_yaml(text)["image"]
        if not isinstance(image, str) or Path(image).name != image:
            raise SourceError(f"{description}: the image {one_line(repr(image))} must be a file beside the description")
        return parse_map(str(description), _content(description.parent / image), text)
    except OSError as error:
        raise SourceError(
            f"{one_line(str(error.filename))}: no map can be read ({error.strerror}); give a run folder or a map.yaml"
        ) from error
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{description}: names no image; give a run folder or the YAML file of a map") from error
    except EvaluationError as error:
        raise SourceError(str(error)) from error


def run_localization(
    source: Source,
    occupancy: OccupancyMap,
    config: MissionConfig,
    initial: FloatArray | None = None,
    progress: Callable[[LocalizationProgress], None] = lambda _: None,
) -> Run:
    """Localise a robot in a map, which does not change.

    Args:
        source: the robot's recording.
        occupancy: the map.
        config: the settings of the robot.
        initial: about where the recording starts in the map, (x, y, theta), shape (3,); None: anywhere.
        progress: called every ``REPORTED_SCANS`` scans.

    Returns:
        The believed poses as trajectory, and every pose with standard deviations and quality.

    Raises:
        SourceError: the map or the recording cannot be used.
    """
    localizer = MapLocalizer(frozen_map(occupancy, "the map"), config.robot.localization, config.robot.lidar, initial)
    robot = RobotFrontend(source.name, config.robot, localizer)
    rows: list[_Row] = []
    first_m = np.nan
    for record in source.records():
        # 1. Track the scan; the localizer follows with the keyscans.
        robot.process(record)
        # 2. Place the new scans in the map.
        fresh = _new_rows(robot, localizer.estimate, len(rows))
        rows += fresh
        if np.isnan(first_m) and localizer.estimate is not None:
            first_m = robot.travel_m
        if len(rows) // REPORTED_SCANS > (len(rows) - len(fresh)) // REPORTED_SCANS:
            progress(LocalizationProgress(len(rows), rows[-1].T_map_base is not None, rows[-1].quality))
    losses = localizer.losses  # without the end of the recording
    robot.finish()
    rows += _new_rows(robot, localizer.estimate, len(rows))
    counts = Metric("fixes", localizer.fixes, "1"), Metric("losses", losses, "1")
    return _run(source.name, rows, occupancy, (Metric("first_fix_after", first_m, "m"), *counts), config)


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """One scan."""

    stamp: float
    T_map_base: FloatArray | None
    sigma: FloatArray | None
    quality: float


def _new_rows(robot: RobotFrontend, estimate: MapEstimate | None, known: int) -> list[_Row]:
    """The scans that were tracked since ``known`` ones, at the newest estimate."""
    rows: list[_Row] = []
    first = known - sum(len(track) for track in robot.tracks[:-1])
    track = robot.scan_poses
    for number in range(first, len(track)):
        if estimate is None:
            rows.append(_Row(track[number].stamp, None, None, 0.0))
        else:
            T_map_base = se2.compose(estimate.T_map_odom, track.in_odom(track[number]))
            sigma = np.sqrt(np.diag(estimate.covariance))
            rows.append(_Row(track[number].stamp, T_map_base, sigma, estimate.quality))
    return rows


def _run(name: str, rows: list[_Row], occupancy: OccupancyMap, found: tuple[Metric, ...], config: MissionConfig) -> Run:
    unknown = np.full(3, np.nan)
    poses = LocalizedPoses(
        name,
        frozen([row.stamp for row in rows]),
        frozen(np.array([unknown if row.T_map_base is None else row.T_map_base for row in rows]).reshape(-1, 3)),
        frozen(np.array([unknown if row.sigma is None else row.sigma for row in rows]).reshape(-1, 3)),
        frozen([row.quality for row in rows]),
    )
    believed = poses.believed()
    metrics = (
        Metric("scans", len(rows), "1"),
        Metric("localized_share", float(poses.is_localized.mean()) if rows else 0.0, "1"),
        *found,
    )
    return Run(
        trajectories={name: believed},
        metrics={metric.name: metric for metric in metrics},
        config_yaml=dump(config),
        map_files={
            "map.pgm": pgm_bytes(occupancy),
            MAP_YAML: map_yaml(occupancy, "map.pgm").encode(),
            "map.png": map_png(occupancy, {name: believed.T_map_base}, ()),
        },
        localized={name: poses},
    )


def _content(path: Path) -> bytes:
    with path.open("rb") as file:
        content = file.read(LARGEST_FILE + 1)
    if len(content) > LARGEST_FILE:
        raise SourceError(f"{path}: larger than {LARGEST_FILE >> 20} MiB")
    return content
