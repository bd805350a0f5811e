"""Logs whose conventions had to be found out: their scans and their wheels tell the same, and no longer if turned."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from convert_logs import readable

from fcslam.geometry import se2
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import LaserScan
from fcslam.sources import open_source
from fcslam.sources.contradictions import RepeatedScans
from tests.sources.carmen_text import scans_of

DATA = Path(os.environ.get("FCSLAM_DATA", "")) / "lidar"
pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif("FCSLAM_DATA" not in os.environ, reason="needs the real logs: set FCSLAM_DATA"),
]
CELL_M = 0.05
WINDOW = 15
LOGS = ["duke-loop5/loop5.log.gz", *(f"mines-coreslam/{name}.dat.gz" for name in ("exp1", "exp2", "exp3", "exp4"))]
OLDER_LOGS = ["mines-coreslam/test_lab.dat.gz", "mines-coreslam/test_lab2.dat.gz"]


def mirrored(scan: LaserScan) -> LaserScan:
    return replace(scan, ranges_m=scan.ranges_m[::-1].copy())


def turned_about(scan: LaserScan) -> LaserScan:
    return replace(scan, laser=replace(scan.laser, T_base_laser=(-scan.laser.T_base_laser[0], 0.0, np.pi)))


def blur(scans: list[LaserScan]) -> float:
    """Cells that the returns of neighbouring scans fall into by odometry alone, as a share of the returns."""
    cells = returns = 0
    for first in range(0, len(scans), WINDOW):
        points = np.concatenate([points_in_odom(scan) for scan in scans[first : first + WINDOW]])
        cells += len(np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0))
        returns += len(points)
    return cells / returns


def points_in_odom(scan: LaserScan) -> np.ndarray:
    hit = np.flatnonzero((scan.ranges_m > 0.0) & (scan.ranges_m < scan.laser.max_range_m))
    angles = scan.laser.angles_rad()[hit]
    points = scan.ranges_m[hit, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return se2.transform(se2.compose(scan.T_odom_base, np.array(scan.laser.T_base_laser)), points)


@pytest.mark.parametrize("log", LOGS + OLDER_LOGS)
@pytest.mark.parametrize("turned", [mirrored, turned_about])
def test_scans_lie_on_one_another_only_by_the_right_conventions(log: str, turned: Callable[[LaserScan], LaserScan]):
    scans = scans_of(open_source(readable(DATA / log)))
    assert blur(scans) < 0.85 * blur([turned(scan) for scan in scans])


@pytest.mark.parametrize("log", LOGS[:2])
def test_the_map_confirms_the_wheels(log):
    source = open_source(readable(DATA / log))
    (trajectory,) = run_mission([source], MissionConfig()).trajectories.values()
    repeated = RepeatedScans()
    odometry = np.array([scan.T_odom_base for scan in scans_of(source) if repeated.admits(scan)])
    assert trajectory.path_length_m == pytest.approx(source.survey().path_length_m, rel=0.05)
    by_wheels, by_map = (se2.between(poses[:-20], poses[20:]) for poses in (odometry, trajectory.T_map_base))
    gap = se2.between(by_wheels, by_map)
    assert np.median(np.hypot(gap[:, 0], gap[:, 1])) < 0.08 * np.median(np.hypot(by_map[:, 0], by_map[:, 1]))
    assert np.median(np.abs(gap[:, 2])) < 0.05
