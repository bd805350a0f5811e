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
from fcslam.records import FloatArray, LaserModel, LaserScan, frozen
from fcslam.simulation.floorplan import FloorPlan, draw_floor_plan
from fcslam.simulation.route import draw_goals, drive, plan_route
from fcslam.simulation.truth import write_truth

FIRST_STAMP = 1000.0
STAMP_SHIFT_S = 0.001
"""Between robots, so that a stamp tells which robot it belongs to."""


class LidarSettings(Settings):
    """The simulated LiDAR."""

    beams: int = Field(default=360, ge=8, description="beams of one full turn")
    max_range_m: float = Field(default=12.0, gt=0.0, description="beams that go further return nothing")
    range_noise_m: float = Field(default=0.015, ge=0.0, description="standard deviation of a range")
    dropout: float = Field(
        default=0.01, ge=0.0, le=1.0, description="share of beams that return nothing without a reason"
    )
    rate_hz: float = Field(default=5.0, gt=0.0, description="scans a second")


class DriftSettings(Settings):
    """How wheel odometry goes wrong: chance along the way, and a bias drawn once for each robot."""

    travel_noise_m: float = Field(
        default=0.01, ge=0.0, description="standard deviation after 1 m; grows with the square root"
    )
    heading_noise_rad: float = Field(default=0.01, ge=0.0, description="standard deviation of the heading after 1 m")
    turn_noise_rad: float = Field(
        default=0.02, ge=0.0, description="standard deviation of the heading after turning 1 rad"
    )
    scale_bias: float = Field(
        default=0.01, ge=0.0, description="standard deviation of the wrong scale of travel and of turns"
    )
    veer_bias_rad_m: float = Field(default=0.003, ge=0.0, description="standard deviation of the constant veer a metre")
    slips_per_m: float = Field(default=0.0, ge=0.0, description="how often wheels turn without moving the robot")
    slip_m: float = Field(default=0.05, ge=0.0, description="mean travel that a slip makes up")


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
    """Write one CARMEN log for each robot, and the truth as ``write_truth`` does; returns the logs."""
    from fcslam.sources import write_carmen

    folder.mkdir(parents=True, exist_ok=True)
    logs = []
    for robot in fleet.robots:
        logs.append(folder / f"{robot.name}.clf")
        write_carmen(logs[-1], robot.scans())
    write_truth(fleet, folder, rng)
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


def drift(T_building_base: FloatArray, settings: DriftSettings, rng: np.random.Generator) -> FloatArray:
    """Odometry (N, 3) of a robot that drove the true poses (N, 3): zero at first, then ever more wrong."""
    twists = se2.log(se2.relative(T_building_base))
    travel, turn = np.abs(twists[:, 0]), np.abs(twists[:, 2])
    scale_travel, scale_turn = 1.0 + rng.normal(0.0, settings.scale_bias, 2)
    veer = rng.normal(0.0, settings.veer_bias_rad_m)
    noise = rng.normal(0.0, 1.0, (3, len(twists)))
    wrong = np.column_stack(
        (
            scale_travel * twists[:, 0] + settings.travel_noise_m * np.sqrt(travel) * noise[0],
            twists[:, 1],
            scale_turn * twists[:, 2]
            + veer * travel
            + settings.heading_noise_rad * np.sqrt(travel) * noise[1]
            + settings.turn_noise_rad * np.sqrt(turn) * noise[2],
        )
    )
    if settings.slips_per_m:
        slips = rng.poisson(settings.slips_per_m * travel)
        wrong[:, 0] += rng.exponential(settings.slip_m, len(travel)) * slips * np.sign(twists[:, 0])
    return _chain(se2.exp(wrong))


def sense(
    plan: FloorPlan, T_building_base: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator
) -> FloatArray:
    """Noisy ranges (N, beams) seen from the true poses (N, 3); ``max_range_m`` where nothing returns."""
    T_building_laser = se2.compose(T_building_base, laser.T_base_laser)
    ranges = cast_rays(T_building_laser, laser.angles_rad(), plan.segments, laser.max_range_m)
    return disturb(ranges, laser, settings, rng)


def disturb(ranges: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator) -> FloatArray:
    """True ranges (..., beams) with noise and dropouts."""
    hit = ranges < laser.max_range_m
    noisy = np.clip(ranges + rng.normal(0.0, settings.range_noise_m, ranges.shape), 0.0, laser.max_range_m)
    return np.where(hit & (rng.random(ranges.shape) >= settings.dropout), noisy, laser.max_range_m)


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


def _chain(motions: FloatArray) -> FloatArray:
    """Poses (N + 1, 3) that start at zero and follow ``motions`` (N, 3)."""
    headings = np.insert(np.cumsum(motions[:, 2]), 0, 0.0)
    steps = np.column_stack((motions[:, :2], np.zeros(len(motions))))
    turned = se2.compose(np.column_stack((np.zeros((len(motions), 2)), headings[:-1])), steps)
    positions = np.vstack((np.zeros(2), np.cumsum(turned[:, :2], axis=0)))
    return np.column_stack((positions, se2.wrap_angle(headings)))
