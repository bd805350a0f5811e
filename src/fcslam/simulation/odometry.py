"""Errors of simulated wheel odometry."""

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.records import FloatArray
from fcslam.simulation.options import OdometryKind


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


_GOOD = OdometryNoiseSettings(heading_noise_rad=0.003, veer_bias_rad_m=0.001, scale_bias=0.015)

KINDS = {
    OdometryKind.DEFAULT: OdometryNoiseSettings(slips_per_m=0.05),
    OdometryKind.GOOD: _GOOD,
    OdometryKind.SLIPPING: _GOOD.model_copy(
        update={"slips_per_m": 0.05, "slip_m": 0.25, "slip_limit_m": 0.7, "slip_turn_rad": 0.1}
    ),
}
"""The errors of each kind of wheel odometry."""


def simulate_odometry(
    T_building_base: FloatArray, settings: OdometryNoiseSettings, rng: np.random.Generator
) -> FloatArray:
    """Simulate the odometry of a robot along true poses (N, 3), metres and radians.

    Returns:
        ``T_odom_base``, shape (N, 3); the first is zero.
    """
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
    return _chain(se2.exp(wrong))


def _chain(motions: FloatArray) -> FloatArray:
    """Accumulate ``motions`` (N, 3) to poses (N + 1, 3) that start at zero."""
    headings = np.insert(np.cumsum(motions[:, 2]), 0, 0.0)
    steps = np.column_stack((motions[:, :2], np.zeros(len(motions))))
    turned = se2.compose(np.column_stack((np.zeros((len(motions), 2)), headings[:-1])), steps)
    positions = np.vstack((np.zeros(2), np.cumsum(turned[:, :2], axis=0)))
    return np.column_stack((positions, se2.wrap_angle(headings)))
