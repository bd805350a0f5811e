"""Readings of simulated wheel odometry with their errors."""

from typing import NamedTuple

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lab.simulation.options import OdometryKind
from fcslam.records import SAME_STAMP_S, FloatArray, Odometry, frozen

READING_RATE_HZ = 50.0
"""Readings per second beside a LiDAR that spins."""
_CARPET_M = 4.0
"""Side of a piece of carpet."""


class OdometryFaults(Settings):
    """Faults of wheel odometry beyond noise."""

    carpet_slip: float = Field(
        default=0.0, ge=0.0, description="share by which wheels turn too far on carpet, a quarter of the floor"
    )
    update_hz: float | None = Field(
        default=None, gt=0.0, description="changes of the pose per second [Hz]; null: every reading is new"
    )
    delay_s: float = Field(default=0.0, ge=0.0, description="time by which the stamp of a reading is late [s]")
    reset_at: float | None = Field(
        default=None, gt=0.0, lt=1.0, description="share of the drive after which the odometry starts at zero again"
    )


class OdometryNoiseSettings(Settings):
    """Errors of wheel odometry: noise along the path, and biases drawn once for each robot."""

    travel_noise_m: float = Field(
        default=0.01,
        ge=0.0,
        description="standard deviation of the measured distance after 1 m, grows with the root of the distance [m]",
    )
    heading_noise_rad: float = Field(
        default=0.01,
        ge=0.0,
        description="standard deviation of the heading after 1 m, grows with the root of the distance [rad]",
    )
    turn_noise_rad: float = Field(
        default=0.02,
        ge=0.0,
        description="standard deviation of the heading after a turn of 1 rad, grows with the root of the turn [rad]",
    )
    scale_bias: float = Field(
        default=0.01, ge=0.0, description="standard deviation of the relative scale error of distances and of turns"
    )
    veer_bias_rad_m: float = Field(
        default=0.003, ge=0.0, description="standard deviation of a robot's constant heading drift [rad/m]"
    )
    slips_per_m: float = Field(default=0.0, ge=0.0, description="mean number of wheel slips per distance [1/m]")
    slip_m: float = Field(default=0.05, ge=0.0, description="mean distance that a wheel slip adds to the odometry [m]")
    slip_limit_m: float | None = Field(
        default=None, gt=0.0, description="largest distance that a wheel slip adds [m]; null for no limit"
    )
    slip_turn_rad: float = Field(
        default=0.0, ge=0.0, description="largest turn that a wheel slip adds, to either side [rad]"
    )
    faults: OdometryFaults = Field(default=OdometryFaults(), description="faults beyond noise")


_GOOD = OdometryNoiseSettings(heading_noise_rad=0.003, veer_bias_rad_m=0.001, scale_bias=0.015)

KINDS: dict[OdometryKind, OdometryNoiseSettings | None] = {
    OdometryKind.DEFAULT: OdometryNoiseSettings(slips_per_m=0.05),
    OdometryKind.GOOD: _GOOD,
    OdometryKind.SLIPPING: _GOOD.model_copy(
        update={"slips_per_m": 0.05, "slip_m": 0.25, "slip_limit_m": 0.7, "slip_turn_rad": 0.1}
    ),
    OdometryKind.SCALED: _GOOD.model_copy(update={"scale_bias": 0.1}),
    OdometryKind.CARPET: _GOOD.model_copy(update={"faults": OdometryFaults(carpet_slip=0.2)}),
    OdometryKind.STEPS: _GOOD.model_copy(update={"faults": OdometryFaults(update_hz=5.0)}),
    OdometryKind.LATE: _GOOD.model_copy(update={"faults": OdometryFaults(delay_s=0.2)}),
    OdometryKind.RESET: _GOOD.model_copy(update={"faults": OdometryFaults(reset_at=0.5)}),
    OdometryKind.NONE: None,
}
"""The errors of each kind of wheel odometry."""


class Readings(NamedTuple):
    """The odometry of a robot as it is recorded."""

    stamps: FloatArray
    """Shape (N,), seconds."""
    T_odom_base: FloatArray
    """Shape (N, 3)."""

    def at(self, stamps: FloatArray) -> FloatArray:
        """Poses (M, 3) at ``stamps`` (M,), interpolated along SE(2) twists, but never beyond the first and the last."""
        if np.array_equal(stamps, self.stamps):
            return self.T_odom_base
        before = np.clip(np.searchsorted(self.stamps, stamps) - 1, 0, len(self.stamps) - 2)
        share = (stamps - self.stamps[before]) / (self.stamps[before + 1] - self.stamps[before])
        step = se2.log(se2.between(self.T_odom_base[before], self.T_odom_base[before + 1]))
        return frozen(se2.compose(self.T_odom_base[before], se2.exp(np.clip(share, 0.0, 1.0)[:, None] * step)))

    def around(self, begin_s: float, end_s: float) -> list[Odometry]:
        """The readings between two stamps, and one more before and after if there is one."""
        first, last = np.searchsorted(self.stamps, (begin_s, end_s))
        kept = slice(max(0, first - 1), last + 1)
        return list(map(Odometry, self.stamps[kept].tolist(), self.T_odom_base[kept]))


def read_odometry(
    stamps: FloatArray, T_building_base: FloatArray, settings: OdometryNoiseSettings, rng: np.random.Generator
) -> Readings:
    """The readings of a robot that is at the true poses (N, 3) at ``stamps`` (N,), with all faults."""
    faults, poses = settings.faults, simulate_odometry(T_building_base, settings, rng)
    if faults.update_hz is not None:
        _, first, number = np.unique(
            np.floor((stamps - stamps[0] + SAME_STAMP_S) * faults.update_hz), return_index=True, return_inverse=True
        )
        poses = poses[first[number]]
    if faults.reset_at is not None:
        after = int(faults.reset_at * len(poses))
        poses = np.concatenate((poses[:after], se2.between(poses[after], poses[after:])))
    return Readings(frozen(stamps + faults.delay_s), frozen(poses))


def simulate_odometry(
    T_building_base: FloatArray, settings: OdometryNoiseSettings, rng: np.random.Generator
) -> FloatArray:
    """``T_odom_base`` (N, 3) of a robot along true poses (N, 3), metres and radians; the first is zero."""
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
        slipped_m = rng.exponential(settings.slip_m, len(travel)) * slips
        if settings.slip_limit_m is not None:
            slipped_m = np.minimum(slipped_m, settings.slip_limit_m)
        wrong[:, 0] += slipped_m * np.sign(twists[:, 0])
        if settings.slip_turn_rad:
            wrong[:, 2] += rng.uniform(-settings.slip_turn_rad, settings.slip_turn_rad, len(travel)) * (slips > 0)
    if settings.faults.carpet_slip:
        column, row = np.floor(T_building_base[:-1, :2] / _CARPET_M).T % 2
        wrong *= 1.0 + settings.faults.carpet_slip * (column * row)[:, None]
    return _chain(se2.exp(wrong))


def _chain(motions: FloatArray) -> FloatArray:
    """Accumulate ``motions`` (N, 3) to poses (N + 1, 3) that start at zero."""
    headings = np.insert(np.cumsum(motions[:, 2]), 0, 0.0)
    steps = np.column_stack((motions[:, :2], np.zeros(len(motions))))
    turned = se2.compose(np.column_stack((np.zeros((len(motions), 2)), headings[:-1])), steps)
    positions = np.vstack((np.zeros(2), np.cumsum(turned[:, :2], axis=0)))
    return np.column_stack((positions, se2.wrap_angle(headings)))
