"""Turns of a 3D LiDAR from whatever recorded them: which points count, when each was measured, and bad recordings."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import tau
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import SourceError
from fcslam.records import CloudScan, FloatArray, LaserModel, SensorRecord, frozen
from fcslam.sources.faults import Audit, Faults
from fcslam.sources.gate import check_consistency
from fcslam.sources.point_clouds import (
    DIRECTIONS,
    FARTHEST_M,
    FLOOR_REACH_M,
    CloudBand,
    CloudMounting,
    PointCloud,
    floor_in,
    turn_of,
    unit_problem,
)
from fcslam.sources.source import Survey

BAND_LASER: Final = LaserModel(DIRECTIONS // 2, -np.pi, 2.0 * tau / DIRECTIONS, FARTHEST_M)
"""The 2D laser in ``base`` that a 3D LiDAR stands for."""
_FEWEST_POINTS: Final = 50
_ONE_RING_RAD: Final = 0.02
"""Largest spread of the elevations of the points of one ring."""
_FASTEST_RAD_S: Final = 40.0 * tau
"""No LiDAR turns faster."""
_FLOOR_M, _FLOOR_SHARE = 0.15, 0.05
"""Points this near to a plane are on it; least share of the points that are on a floor."""
FEWEST_ON_FLOOR: Final = 6
"""Points of a floor, at least."""
_LEAST_EXTENT_M, _THICKEST_M = 0.3, 0.04
"""Least standard deviation of the points of a floor in every direction, and the largest along its normal."""
_FEW_FLOORS: Final = 0.1
"""If at most this share of the clouds shows a floor where the mounting has it, this is wrong; else 0.2 or more do."""
_FEW_BELOW, _MANY_BELOW = 0.02, 0.1
"""Points below the floor: a LiDAR upside down sees more than the first share; mounted otherwise, than the second."""


class CloudRecording(ABC):
    """A recording of one robot with a 3D LiDAR."""

    def __init__(self, path: Path, name: str, unit: str) -> None:
        """``unit`` is what holds a cloud."""
        self.path, self.name, self._unit = path, name, unit
        self._audit = Audit(unit)

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._audit.faults()

    @abstractmethod
    def survey(self) -> Survey:
        """As in Source; clouds are counted, and only the first ones are decoded."""

    @abstractmethod
    def _scans(self, audit: Audit) -> Iterator[tuple[int, CloudScan]]:
        """All clouds with their numbers; ``audit`` counts the faults."""

    def records(self) -> Iterator[SensorRecord]:
        """As in Source; every cloud carries the readings of the other sensors."""
        audit = self._audit = Audit(self._unit)
        count = 0
        for _, scan in self._scans(audit):
            count += 1
            yield scan
        check_consistency(self.path, audit.faults(), count, count)


@dataclass(frozen=True)
class CloudReader:
    """Turns clouds of one sensor into records."""

    mounting: CloudMounting
    is_timed: bool
    """Whether the times of the points count."""
    period_s: float
    """Time between clouds. Without other times, points in order have equal steps of it; 0: they are in no order."""
    body_radius_m: float
    """Points nearer to the vertical through ``base`` are of the robot itself."""

    def times_s(self, cloud: PointCloud) -> NDArray[np.float64]:
        """When each point was measured after the stamp, shape (N,)."""
        if self.is_timed and len(cloud.times_s):
            return cloud.times_s
        return np.linspace(0.0, self.period_s, len(cloud.points), endpoint=False)

    def scan(self, cloud: PointCloud, wheels: FloatArray, imu: FloatArray) -> CloudScan:
        """The record of a cloud with the readings since the previous one; raises ValueError if it has few points."""
        if len(cloud.points) < _FEWEST_POINTS:
            raise ValueError(f"{len(cloud.points)} points are not a turn of a 3D LiDAR")
        points, times = self.mounting.in_base(cloud), self.times_s(cloud)
        outside = np.hypot(points[:, 0], points[:, 1]) > self.body_radius_m
        return CloudScan(
            cloud.stamp,
            frozen(points[outside], np.float32),
            frozen(times[outside], np.float32),
            frozen(self.mounting.position_m),
            frozen(wheels),
            frozen(imu),
        )


def reader_of(
    first: Sequence[PointCloud], mounting: CloudMounting, band: CloudBand, where: str
) -> tuple[CloudReader, tuple[str, ...]]:
    """How to read clouds like the ``first`` ones of a sensor, and notes about them; messages begin with ``where``.

    Raises:
        SourceError: they cannot be mapped.
    """
    if max(len(cloud.points) for cloud in first) < _FEWEST_POINTS:
        raise SourceError(f"{where} has hardly any points; check the driver, or choose another by --sensors scan-topic")
    if problem := unit_problem(first):
        raise SourceError(f"{where}: {problem}")
    elevations = [np.arctan2(cloud.points[:, 2], np.hypot(*cloud.points[:, :2].T)) for cloud in first]
    if max(float(np.ptp(np.quantile(each, (0.05, 0.95)))) for each in elevations if len(each)) < _ONE_RING_RAD:
        raise SourceError(f"{where} has one ring, so it is a 2D laser; map it without --3d, or with its laser scans")
    notes = []
    stamps = np.array([cloud.stamp for cloud in first])
    period_s = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    is_timed = any(len(cloud.times_s) for cloud in first)
    xy = [(cloud.points @ mounting.rotation.T)[:, :2] for cloud in first]
    in_order = _turns(xy, [np.linspace(0.0, 1.0, len(each)) for each in xy])
    is_in_order = 2 * len(in_order) > len(xy)
    if is_timed and is_in_order:
        rates = _turns(xy, [cloud.times_s for cloud in first])
        if len(rates) and np.median(rates) * np.median(in_order) < 0.0:
            notes.append(
                f"{where}: the times of the points fall from the first to the last, so the LiDAR is taken to turn "
                "backwards; correct the times in the driver, unless it really sends the last point first"
            )
        is_timed = 2 * len(rates) > len(xy) and float(np.median(np.abs(rates))) < _FASTEST_RAD_S
        if not is_timed:
            notes.append(
                f"{where}: the times of the points contradict how the LiDAR turns; their order gives them: correct the "
                "unit of the times in the driver"
            )
    period_s = max(period_s, 0.0) if is_in_order else 0.0
    if not any(len(cloud.times_s) for cloud in first):
        order = "their order gives them" if period_s else "the motion in a turn is not corrected: drive slowly"
        notes.append(f"{where}: the points have no times in a usual unit; {order}")
    if not mounting.is_height_known:
        mounting = _on_floor(first, mounting) or mounting._replace(is_height_known=True)
    flipped = mounting._replace(rotation=np.diag([1.0, -1.0, -1.0]) @ mounting.rotation)
    on_floor, below = _shares(first, mounting)
    is_off = _floors(first, mounting) <= _FEW_FLOORS
    if is_off and below > _FEW_BELOW and _floors(first, flipped) > 0.5:
        mounting = flipped
        notes.append(
            f"{where}: many points are below the floor, so the LiDAR is upside down; corrected: correct it in tf"
        )
    elif (on_floor < _FLOOR_SHARE and not any(floor_in(mounting.in_base(cloud), mounting) for cloud in first)) or (
        is_off and below > _MANY_BELOW
    ):
        notes.append(
            f"{where}: no floor is seen where the mounting has it, so maps are levelled by the IMU, or else as the "
            "LiDAR is mounted; check its pose in tf"
        )
    return CloudReader(mounting, is_timed, period_s, band.body_radius_m), tuple(notes)


def floor_at(points: FloatArray, reach_m: float = 4.0) -> tuple[FloatArray, float] | None:
    """Normal (3,) and distance of the floor below the base, from points (N, 3) in ``base``; None if few show it."""
    near = points[(np.abs(points[:, 2]) < _FLOOR_M) & (np.hypot(points[:, 0], points[:, 1]) < reach_m)]
    for _ in range(2):
        if len(near) < FEWEST_ON_FLOOR:
            return None
        middle = near.mean(axis=0)
        variances, axes = np.linalg.eigh(np.cov((near - middle).T))
        normal = axes[:, 0] * np.copysign(1.0, axes[2, 0])
        off = np.abs((near - middle) @ normal)
        near = near[off < max(2.0 * np.sqrt(variances[0]), 0.02)]
    is_floor = variances[1] > _LEAST_EXTENT_M**2 and variances[0] < _THICKEST_M**2
    return (normal, float(normal @ middle)) if is_floor else None


def _turns(xy: Sequence[FloatArray], times_s: Sequence[NDArray[np.float64]]) -> list[float]:
    """Rates, in rad/s, of the clouds in which the LiDAR turns by these times."""
    turns = (turn_of(points, times) for points, times in zip(xy, times_s, strict=True) if len(points) == len(times))
    return [turn[1] for turn in turns if turn is not None]


def _on_floor(first: Sequence[PointCloud], mounting: CloudMounting) -> CloudMounting | None:
    """The mounting with the height above the floor that most clouds show; None if most show no floor."""
    floors = [floor_in(mounting.in_base(cloud), mounting) for cloud in first]
    heights_m = [float(normal @ mounting.position_m) - distance_m for normal, distance_m in filter(None, floors)]
    if 2 * len(heights_m) < len(first):
        return None
    position = mounting.position_m + np.array([0.0, 0.0, float(np.median(heights_m))])
    return mounting._replace(position_m=position, is_height_known=True)


def _floors(first: Sequence[PointCloud], mounting: CloudMounting) -> float:
    """Share of the clouds that show a floor where the mounting has it."""
    return float(np.mean([floor_at(mounting.in_base(cloud), FLOOR_REACH_M) is not None for cloud in first]))


def _shares(first: Sequence[PointCloud], mounting: CloudMounting) -> tuple[float, float]:
    """Shares of the points on the floor, and below it."""
    points = np.concatenate([mounting.in_base(cloud) for cloud in first])
    return float(np.mean(np.abs(points[:, 2]) < _FLOOR_M)), float(np.mean(points[:, 2] < -_FLOOR_M))
