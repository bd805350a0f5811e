"""A simulated fleet with LiDARs and cameras in one furnished building: routes, sensor records and true poses.

One seed decides everything. The building, its appearance, the furniture and the goals of the fleet depend on the seed
alone. The route, odometry and noise of a robot, and the furniture that moved before it, depend on the seed and the
robot's number. So another robot changes nothing for the others, and cameras change nothing for the LiDARs.
"""

import math
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.errors import InputError
from fcslam.lab.simulation.decoration import Decoration, decorate, light_of
from fcslam.lab.simulation.floorplan import FloorPlan, draw_floor_plan, move_furniture
from fcslam.lab.simulation.noise import SCANNERS, LidarSettings, simulate_ranges
from fcslam.lab.simulation.odometry import KINDS, READING_RATE_HZ, Readings, read_odometry
from fcslam.lab.simulation.options import Building, Lighting, OdometryKind, Scanner
from fcslam.lab.simulation.route import TURN_RATE_RAD_S, Schedule, draw_goals, plan_route, schedule
from fcslam.lab.simulation.scene import bare_model, furnished_model
from fcslam.lab.simulation.sensors import Camera, RayCaster
from fcslam.records import (
    CameraImage,
    CameraModel,
    FloatArray,
    LaserModel,
    LaserScan,
    Odometry,
    SensorRecord,
    Transform,
    frozen,
)
from fcslam.sources.motion import moving_sweep
from fcslam.sources.pose import UNKNOWN_POSE

FIRST_STAMP = 1000.0
STAMP_SHIFT_S = 0.001
"""Offset between the stamps of two robots, so that a stamp identifies its robot."""
_T_BASE_LASER = (0.05, 0.0, 0.0)
_BUILDING, _LOOKS, _GOALS, _ROBOTS, _LAMPS, _SCANS, _IMAGES = range(7)
"""Purposes of random numbers. Each has its own generator, so that none affects another; ``_ROBOTS``: moved furniture,
route and odometry of a robot."""


class Caster(Protocol):
    """Casts beams on a plan. The pose (3,) is that of the robot, or its poses at each beam, shape (beam_count, 3)."""

    def cast(self, T_building_base: FloatArray, laser: LaserModel) -> FloatArray:
        """Ranges (beam_count,) in metres without any error; ``max_range_m`` without a hit."""

    def scan(self, T_building_base: FloatArray, laser: LaserModel, rng: np.random.Generator) -> FloatArray:
        """Ranges (beam_count,) in metres before noise; ``max_range_m`` without a return."""


class World:
    """A building. For another world, override these methods."""

    def __init__(self, building: Building) -> None:
        self._building = building

    def draw(self, rng: np.random.Generator) -> FloorPlan:
        """The plan as the first robot finds it."""
        return draw_floor_plan(rng, self._building)

    def goals(self, plan: FloorPlan, robots: int, length_m: float, rng: np.random.Generator) -> list[FloatArray]:
        """Goals (G, 2) of each robot. Another robot changes nothing for those before it."""
        return draw_goals(plan, robots, length_m, rng)

    def changed(self, plan: FloorPlan, goals: FloatArray, share: float, rng: np.random.Generator) -> FloorPlan:  # noqa: ARG002
        """The plan after a ``share`` of the furniture has moved, as a robot with these goals finds it."""
        return move_furniture(plan, share, rng)

    def route(self, plan: FloorPlan, goals: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
        """Waypoints (K, 2) of a path of about ``length_m`` metres."""
        return plan_route(plan, goals, length_m, rng)

    def caster(self, plan: FloorPlan) -> Caster:
        """The beams of lasers on ``plan``."""
        return RayCaster(bare_model(plan))


class CameraSettings(Settings):
    """The simulated camera, which looks straight ahead."""

    width: int = Field(default=320, ge=16, le=2048, description="width of an image [px]")
    height: int = Field(default=240, ge=16, le=2048, description="height of an image [px]")
    field_of_view_rad: float = Field(default=1.35, gt=0.1, lt=2.8, description="horizontal field of view [rad]")
    rate_hz: float = Field(default=5.0, gt=0.0, description="image rate [Hz]")
    noise: float = Field(default=2.0, ge=0.0, description="standard deviation of the pixel noise [grey levels of 255]")

    def model(self) -> CameraModel:
        """Intrinsics and mounting."""
        focal = 0.5 * self.width / math.tan(0.5 * self.field_of_view_rad)
        middle = (0.5 * (self.width - 1), 0.5 * (self.height - 1))
        mounting = Transform((0.1, 0.0, 0.6), (-0.5, 0.5, -0.5, 0.5))  # z of the camera is x of the base
        return CameraModel(self.width, self.height, focal, focal, *middle, mounting)


class SimulationSettings(Settings):
    """A simulated fleet."""

    building: Building = Field(
        default=Building.DEFAULT, description="kind of building: flat, default, office or corridor"
    )
    robots: int = Field(default=3, ge=1, description="number of robots")
    path_length_m: float = Field(default=60.0, gt=0.0, le=10_000.0, description="length of each robot's path [m]")
    lighting: tuple[Lighting, ...] = Field(
        default=(Lighting.DAY,), min_length=1, description="lighting of each robot in turn: day, evening or lamp-off"
    )
    moved_furniture: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="share of the furniture in rooms that moves before the second and each further robot",
    )
    turn_rate_rad_s: float = Field(
        default=TURN_RATE_RAD_S, gt=0.0, le=6.0, description="rate at which the robots turn [rad/s]"
    )
    lidar: LidarSettings = SCANNERS[Scanner.INSTANT]
    odometry: OdometryKind = Field(default=OdometryKind.DEFAULT, description="kind of wheel odometry, or of its fault")
    camera: CameraSettings | None = CameraSettings()


@dataclass(frozen=True, slots=True)
class SimulatedRobot:
    """One robot with its route. Its sensor records are computed on demand."""

    name: str
    lasers: tuple[LaserModel]
    camera: CameraModel | None
    stamps: FloatArray
    """Stamps of the scans, shape (N,), seconds."""
    T_building_base: FloatArray
    """True poses at these stamps, shape (N, 3)."""
    T_odom_base: FloatArray
    """Wheel odometry at these stamps, shape (N, 3); NaN without odometry."""
    readings: Readings | None
    """Wheel odometry as it is read; None without odometry. A LiDAR that does not spin has one reading at each scan."""
    image_stamps: FloatArray
    """Stamps of its images, shape (M,), seconds; empty without a camera."""
    world: World
    plan: FloorPlan
    """The building with the furniture at the time of this robot."""
    lighting: Lighting
    settings: SimulationSettings
    decoration: Decoration | None
    route: Schedule
    first_stamp: float
    seed: int
    number: int
    """Counts the fleet's robots from 0."""

    @property
    def duration_s(self) -> float:
        """Time from the first scan to the last."""
        return float(self.stamps[-1] - self.stamps[0])

    @property
    def odometry(self) -> Readings:
        """The readings that are records of their own: those of a robot whose LiDAR spins."""
        if self.readings is None or not self.settings.lidar.spin:
            return Readings(np.empty(0), np.empty((0, 3)))
        return self.readings

    @property
    def truth(self) -> tuple[FloatArray, FloatArray]:
        """The stamps (N,) of scans and images in the order of time, and the true poses (N, 3) at them."""
        stamps = np.sort(np.concatenate((self.stamps, self.image_stamps)), kind="stable")
        return stamps, self.route.at(stamps - self.first_stamp)

    def records(self) -> Generator[SensorRecord, None, None]:
        """Scans, images and odometry in the order of time."""
        odometry = self.odometry
        stamps = np.concatenate((self.stamps, self.image_stamps, odometry.stamps))
        scans, count, end = self.scans(), len(self.stamps), len(self.stamps) + len(self.image_stamps)
        with closing(self._images()) as images:
            for k in np.argsort(stamps, kind="stable"):
                if k >= end:
                    yield Odometry(float(stamps[k]), odometry.T_odom_base[k - end])
                else:
                    yield next(scans) if k < count else next(images)

    def scans(self) -> Iterator[LaserScan]:
        """All scans; every call yields the same."""
        caster, settings, (laser,) = self.world.caster(self.plan), self.settings.lidar, self.lasers
        for k in range(len(self.stamps)):
            rng, stamp, poses = self._generator(_SCANS, k), float(self.stamps[k]), self.T_building_base[k]
            sweep = settings.sweep(laser.beams)
            if sweep is not None:
                times_s = np.linspace(sweep.first_s, sweep.last_s, laser.beam_count)
                poses = self.route.at(stamp - self.first_stamp + times_s)
                if self.readings is not None:
                    sweep = moving_sweep(sweep, stamp, self.readings.around(stamp, stamp + sweep.duration_s))
            ranges = simulate_ranges(caster.scan(poses, laser, rng), laser, settings, rng)
            yield LaserScan(stamp, frozen(ranges, np.float32), laser, self.T_odom_base[k], sweep)

    def _images(self) -> Generator[CameraImage, None, None]:
        settings = self.settings.camera
        if self.camera is None or self.decoration is None or settings is None:
            return
        light = light_of(self.plan, self.lighting, self._generator(_LAMPS))
        fov_y_rad = 2.0 * math.atan(0.5 * self.camera.height / self.camera.fy)
        model = furnished_model(self.plan, self.decoration, light, (settings.width, settings.height), fov_y_rad)
        poses = self.route.at(self.image_stamps - self.first_stamp)
        odometry = None if self.readings is None else self.readings.at(self.image_stamps)
        shape = (settings.height, settings.width, 1)
        with Camera(model, self.camera, light) as camera:
            for k in range(len(self.image_stamps)):
                noise = self._generator(_IMAGES, k).standard_normal(shape, dtype=np.float32)
                picture = camera.take(poses[k]).astype(np.float32)
                encoded = _jpeg(picture + settings.noise * noise)
                T_odom_base = None if odometry is None else odometry[k]
                yield CameraImage(float(self.image_stamps[k]), encoded, self.camera, T_odom_base)

    def _generator(self, purpose: int, record: int = 0) -> np.random.Generator:
        """A generator for each record, so that no record depends on another one."""
        return _generator(self.seed, purpose, self.number, record)


def _generator(seed: int, purpose: int, robot: int = 0, record: int = 0) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose, robot, record)))


@dataclass(frozen=True, slots=True)
class SimulatedFleet:
    """A building and the robots that drive in it."""

    plan: FloorPlan
    robots: tuple[SimulatedRobot, ...]


def simulate_fleet(settings: SimulationSettings, seed: int, world: World | None = None) -> SimulatedFleet:
    """Draw a building and plan the route of each robot; the same seed gives the same fleet.

    ``world`` replaces the building of the settings; cameras see buildings only.
    """
    world = world or World(settings.building)
    plan = world.draw(_generator(seed, _BUILDING))
    _check_room(plan, settings)
    goals = world.goals(plan, settings.robots, settings.path_length_m, _generator(seed, _GOALS))
    decoration = decorate(plan, _generator(seed, _LOOKS)) if settings.camera else None
    robots: list[SimulatedRobot] = []
    for number in range(settings.robots):
        rng = _generator(seed, _ROBOTS, number)
        found = world.changed(plan, goals[number], settings.moved_furniture, rng) if number else plan
        robots.append(_robot(world, found, decoration, number, goals[number], settings, seed, rng))
    return SimulatedFleet(plan, tuple(robots))


def _check_room(plan: FloorPlan, settings: SimulationSettings) -> None:
    lanes_m = sum(float(np.linalg.norm(end - start)) for start, end in plan.lanes)
    most = int(lanes_m / 2.0)  # robots do not see each other, but a crowded corridor is not realistic
    if settings.robots > most:
        raise InputError(
            f"building '{settings.building}': {lanes_m:.0f} m of corridors are too small for {settings.robots} robots; "
            f"simulate at most {most}, or take a larger building"
        )


def _robot(
    world: World,
    plan: FloorPlan,
    decoration: Decoration | None,
    number: int,
    goals: FloatArray,
    settings: SimulationSettings,
    seed: int,
    rng: np.random.Generator,
) -> SimulatedRobot:
    route = schedule(world.route(plan, goals, settings.path_length_m, rng), settings.turn_rate_rad_s)
    if settings.lidar.spin:
        route = route.eased()
    times = np.arange(0.0, route.duration_s, 1.0 / settings.lidar.rate_hz)
    poses, camera = route.at(times), settings.camera
    first_stamp = FIRST_STAMP + number * STAMP_SHIFT_S
    stamps: FloatArray = frozen(np.round(first_stamp + times, 6))
    readings = _readings(route, times, first_stamp, settings, rng)
    image_times = np.arange(0.03, times[-1], 1.0 / camera.rate_hz) if camera else np.empty(0)
    return SimulatedRobot(
        name=f"robot_{number + 1}",
        lasers=(settings.lidar.model(_T_BASE_LASER),),
        camera=camera.model() if camera else None,
        stamps=stamps,
        T_building_base=frozen(poses),
        T_odom_base=frozen(np.tile(UNKNOWN_POSE, (len(stamps), 1))) if readings is None else readings.at(stamps),
        readings=readings,
        image_stamps=frozen(np.round(first_stamp + image_times, 6)),
        world=world,
        plan=plan,
        lighting=settings.lighting[number % len(settings.lighting)],
        settings=settings,
        decoration=decoration,
        route=route,
        first_stamp=first_stamp,
        seed=seed,
        number=number,
    )


def _readings(
    route: Schedule, times: FloatArray, first_stamp: float, settings: SimulationSettings, rng: np.random.Generator
) -> Readings | None:
    errors = KINDS[settings.odometry]
    if errors is None:
        return None
    if settings.lidar.spin:
        times = np.arange(0.0, times[-1] + 1.0 / settings.lidar.rate_hz + 1.0 / READING_RATE_HZ, 1.0 / READING_RATE_HZ)
    return read_odometry(np.round(first_stamp + times, 6), route.at(times), errors, rng)


def _jpeg(pixels: FloatArray) -> bytes:
    import cv2

    image = np.clip(pixels, 0.0, 255.0).astype(np.uint8)
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
    return bytes(encoded)
