"""Readings of simulated wheel odometry with their errors."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fcslam.geometry import se2
from fcslam.lab.simulation.options import OdometryKind
from fcslam.records import SAME_STAMP_S, FloatArray, Odometry, frozen

READING_RATE_HZ = 50.0
"""Readings per second beside a LiDAR that spins."""


@dataclass(frozen=True, slots=True)
class OdometryErrors:
    """Errors of wheel odometry: noise along the path, biases drawn once for each robot, and errors."""

    travel_noise_m: float = 0.01
    """Standard deviation of the measured distance after 1 m; it grows with the root of the distance."""
    heading_noise_rad: float = 0.01
    """Standard deviation of the heading after 1 m; it grows with the root of the distance."""
    turn_noise_rad: float = 0.02
    """Standard deviation of the heading after a turn of 1 rad; it grows with the root of the turn."""
    scale_bias: float = 0.01
    """Standard deviation of the relative scale error of distances and of turns."""
    veer_bias_rad_m: float = 0.003
    """Standard deviation of a robot's constant heading drift."""
    slips_per_m: float = 0.0
    """Mean number of wheel slips."""
    slip_m: float = 0.05
    """Mean distance that a wheel slip adds."""
    slip_limit_m: float = math.inf
    """Largest distance that a wheel slip adds."""
    slip_turn_rad: float = 0.0
    """Largest turn that a wheel slip adds, to either side."""
    carpet_slip: float = 0.0
    """Share by which wheels turn too far on carpet, a quarter of the floor."""
    update_hz: float | None = None
    """Changes of the pose per second; None: every reading is new."""
    delay_s: float = 0.0
    """Time by which the stamp of a reading is late."""
    reset_at: float | None = None
    """Share of the drive after which the odometry starts at zero again."""


_GOOD = OdometryErrors(heading_noise_rad=0.003, veer_bias_rad_m=0.001, scale_bias=0.015)

KINDS: dict[OdometryKind, OdometryErrors | None] = {
    OdometryKind.DEFAULT: OdometryErrors(slips_per_m=0.05),
    OdometryKind.GOOD: _GOOD,
    OdometryKind.SLIPPING: replace(_GOOD, slips_per_m=0.05, slip_m=0.25, slip_limit_m=0.7, slip_turn_rad=0.1),
    OdometryKind.SCALED: replace(_GOOD, scale_bias=0.1),
    OdometryKind.CARPET: replace(_GOOD, carpet_slip=0.2),
    OdometryKind.STEPS: replace(_GOOD, update_hz=5.0),
    OdometryKind.LATE: replace(_GOOD, delay_s=0.2),
    OdometryKind.RESET: replace(_GOOD, reset_at=0.5),
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
    stamps: FloatArray, T_building_base: FloatArray, errors: OdometryErrors, rng: np.random.Generator
) -> Readings:
    """The readings of a robot that is at the true poses (N, 3) at ``stamps`` (N,), with all errors."""
    poses = simulate_odometry(T_building_base, errors, rng)
    if errors.update_hz is not None:
        _, first, number = np.unique(
            np.floor((stamps - stamps[0] + SAME_STAMP_S) * errors.update_hz), return_index=True, return_inverse=True
        )
        poses = poses[first[number]]
    if errors.reset_at is not None:
        after = int(errors.reset_at * len(poses))
        poses = np.concatenate((poses[:after], se2.between(poses[after], poses[after:])))
    return Readings(frozen(stamps + errors.delay_s), frozen(poses))


def simulate_odometry(T_building_base: FloatArray, errors: OdometryErrors, rng: np.random.Generator) -> FloatArray:
    """``T_odom_base`` (N, 3) of a robot along true poses (N, 3), metres and radians; the first is zero."""
    twists = se2.log(se2.relative(T_building_base))
    travel, turn = np.abs(twists[:, 0]), np.abs(twists[:, 2])
    scale_travel, scale_turn = 1.0 + rng.normal(0.0, errors.scale_bias, 2)
    veer = rng.normal(0.0, errors.veer_bias_rad_m)
    noise = rng.normal(0.0, 1.0, (3, len(twists)))
    wrong = np.column_stack(
        (
            scale_travel * twists[:, 0] + errors.travel_noise_m * np.sqrt(travel) * noise[0],
            twists[:, 1],
            scale_turn * twists[:, 2]
            + veer * travel
            + errors.heading_noise_rad * np.sqrt(travel) * noise[1]
            + errors.turn_noise_rad * np.sqrt(turn) * noise[2],
        )
    )
    if errors.slips_per_m:
        slips = rng.poisson(errors.slips_per_m * travel)
        slipped_m = np.minimum(rng.exponential(errors.slip_m, len(travel)) * slips, errors.slip_limit_m)
        wrong[:, 0] += slipped_m * np.sign(twists[:, 0])
        if errors.slip_turn_rad:
            wrong[:, 2] += rng.uniform(-errors.slip_turn_rad, errors.slip_turn_rad, len(travel)) * (slips > 0)
    if errors.carpet_slip:
        column, row = np.floor(T_building_base[:-1, :2] / 4.0).T % 2  # pieces of 4 m
        wrong *= 1.0 + errors.carpet_slip * (column * row)[:, None]
    return _chain(se2.exp(wrong))


def _chain(motions: FloatArray) -> FloatArray:
    """Accumulate ``motions`` (N, 3) to poses (N + 1, 3) that start at zero."""
    headings = np.insert(np.cumsum(motions[:, 2]), 0, 0.0)
    steps = np.column_stack((motions[:, :2], np.zeros(len(motions))))
    turned = se2.compose(np.column_stack((np.zeros((len(motions), 2)), headings[:-1])), steps)
    positions = np.vstack((np.zeros(2), np.cumsum(turned[:, :2], axis=0)))
    return np.column_stack((positions, se2.wrap_angle(headings)))
