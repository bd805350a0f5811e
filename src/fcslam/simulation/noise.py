"""Measurement errors of a simulated LiDAR: range noise and dropouts."""

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.records import FloatArray, LaserModel


class LidarSettings(Settings):
    """The simulated LiDAR."""

    beams: int = Field(default=360, ge=8, description="beams of one revolution of the LiDAR")
    max_range_m: float = Field(default=12.0, gt=0.0, description="largest range of the LiDAR [m]")
    range_noise_m: float = Field(default=0.015, ge=0.0, description="standard deviation of a LiDAR range [m]")
    dropout: float = Field(
        default=0.01, ge=0.0, le=1.0, description="probability that a LiDAR beam that hits a surface returns nothing"
    )
    rate_hz: float = Field(default=5.0, gt=0.0, description="scan rate of the LiDAR [Hz]")


def simulate_ranges(
    ranges: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator
) -> FloatArray:
    """Add noise and dropouts to true ranges (..., beams) in metres; a dropout has ``laser.max_range_m``."""
    hit = ranges < laser.max_range_m
    noisy = np.clip(ranges + rng.normal(0.0, settings.range_noise_m, ranges.shape), 0.0, laser.max_range_m)
    return np.where(hit & (rng.random(ranges.shape) >= settings.dropout), noisy, laser.max_range_m)
