"""A fleet of robots with 2D LiDARs and drifting wheels in a drawn floor plan: no simulator needed, truth known.

Each robot drives a round through rooms and corridors; neighbours share a part. Its odometry starts
at zero wherever the robot stands, so nothing but the scans tells where the robots were relative to each other.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.metrics.relations import write_relations
from fcslam.records import FloatArray, LaserModel, LaserScan, frozen
from fcslam.runs import write_tum
from fcslam.simulation.fleet import FIRST_STAMP, STAMP_SHIFT_S
from fcslam.simulation.floorplan import FloorPlan, draw_floor_plan
from fcslam.simulation.noise import LidarSettings, disturb
from fcslam.simulation.odometry import DriftSettings, drift
from fcslam.simulation.route import draw_goals, drive, plan_route
from fcslam.simulation.truth import true_relations


class FleetSettings(Settings):
    """A drawn fleet."""

    robots: int = Field(default=3, ge=1, description="number of robots")
    path_length_m: float = Field(default=60.0, gt=0.0, description="how far each drives")
    lidar: LidarSettings = LidarSettings()
    drift: DriftSettings = DriftSettings()


@dataclass(frozen=True, slots=True)
class DrawnRobot:
    """One robot's recording with its truth."""

    name: str
    laser: LaserModel
    stamps: FloatArray
    """Shape (N,)."""
    T_building_base: FloatArray
    """The truth, shape (N, 3)."""
    T_odom_base: FloatArray
    """What the wheels say, shape (N, 3), from zero."""
    ranges_m: FloatArray
    """Shape (N, beams)."""

    def scans(self) -> Iterator[LaserScan]:
        """The recording as a source yields it."""
        for stamp, ranges, pose in zip(self.stamps, self.ranges_m, self.T_odom_base, strict=True):
            yield LaserScan(float(stamp), frozen(ranges, np.float32), self.laser, frozen(pose))


@dataclass(frozen=True, slots=True)
class DrawnFleet:
    """A building and the robots that were in it."""

    plan: FloorPlan
    robots: tuple[DrawnRobot, ...]


def draw_fleet(settings: FleetSettings, rng: np.random.Generator) -> DrawnFleet:
    """Draw a building and let the robots drive in it; the same generator state gives the same fleet."""
    plan = draw_floor_plan(rng)
    goals = draw_goals(plan, settings.robots, settings.path_length_m, rng.spawn(1)[0])
    robots = tuple(_draw_robot(plan, number, goals[number], settings, rng) for number in range(settings.robots))
    return DrawnFleet(plan, robots)


def write_fleet(fleet: DrawnFleet, folder: Path, rng: np.random.Generator) -> list[Path]:
    """Write one CARMEN log for each robot, the truth at its scans, and ``ground_truth/relations``; returns the logs."""
    from fcslam.sources import write_carmen

    truth = folder / "ground_truth"
    truth.mkdir(parents=True, exist_ok=True)
    logs = []
    for robot in fleet.robots:
        logs.append(folder / f"{robot.name}.clf")
        write_carmen(logs[-1], robot.scans())
        write_tum(truth / f"{robot.name}.tum", robot.stamps, robot.T_building_base)
    write_relations(truth / "relations", true_relations(fleet.robots, rng))
    return logs


def _draw_robot(
    plan: FloorPlan, number: int, goals: FloatArray, settings: FleetSettings, rng: np.random.Generator
) -> DrawnRobot:
    waypoints = plan_route(plan, goals, settings.path_length_m, rng)
    times, poses = drive(waypoints, 1.0 / settings.lidar.rate_hz)
    laser = LaserModel(settings.lidar.beams, -np.pi, 2.0 * np.pi / settings.lidar.beams, settings.lidar.max_range_m)
    return DrawnRobot(
        name=f"robot_{number + 1}",
        laser=laser,
        stamps=frozen(np.round(FIRST_STAMP + number * STAMP_SHIFT_S + times, 6)),
        T_building_base=frozen(poses),
        T_odom_base=frozen(drift(poses, settings.drift, rng)),
        ranges_m=frozen(sense(plan, poses, laser, settings.lidar, rng)),
    )


def sense(
    plan: FloorPlan, T_building_base: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator
) -> FloatArray:
    """Noisy ranges (N, beams) seen from the true poses (N, 3); ``max_range_m`` where nothing returns."""
    T_building_laser = se2.compose(T_building_base, laser.T_base_laser)
    ranges = cast_rays(T_building_laser, laser.angles_rad(), plan.segments, laser.max_range_m)
    return disturb(ranges, laser, settings, rng)


@njit(cache=True)
def cast_rays(poses: FloatArray, angles: FloatArray, segments: FloatArray, max_range: float) -> FloatArray:
    """Distance (N, B) from each pose (N, 3) along each angle (B,) to the first segment (S, 4), or ``max_range``."""
    ranges = np.full((len(poses), len(angles)), max_range)
    for i in range(len(poses)):
        x, y, theta = poses[i]
        for b in range(len(angles)):
            cos, sin = np.cos(theta + angles[b]), np.sin(theta + angles[b])
            nearest = max_range
            for s in range(len(segments)):
                ax, ay = segments[s, 0] - x, segments[s, 1] - y
                bx, by = segments[s, 2] - x, segments[s, 3] - y
                # The ends' offsets across the ray: it meets the segment where they have different signs.
                across_a, across_b = cos * ay - sin * ax, cos * by - sin * bx
                if (across_a > 0.0) != (across_b > 0.0):
                    share = across_a / (across_a - across_b)
                    along = cos * (ax + share * (bx - ax)) + sin * (ay + share * (by - ay))
                    if 0.0 < along < nearest:
                        nearest = along
            ranges[i, b] = nearest
    return ranges
