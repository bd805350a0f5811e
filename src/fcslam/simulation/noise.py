"""How a LiDAR measures wrongly: noise, and beams that are lost."""

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.records import FloatArray, LaserModel


class LidarSettings(Settings):
    """The simulated LiDAR."""

    beams: int = Field(default=360, ge=8, description="beams of one full turn")
    max_range_m: float = Field(default=12.0, gt=0.0, description="beams that go further return nothing")
    range_noise_m: float = Field(default=0.015, ge=0.0, description="standard deviation of a range")
    dropout: float = Field(
        default=0.01, ge=0.0, le=1.0, description="share of beams that return nothing without a reason"
    )
    rate_hz: float = Field(default=5.0, gt=0.0, description="scans a second")


def simulate_ranges(
    ranges: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator
) -> FloatArray:
    """True ranges (..., beams) with noise and dropouts."""
    hit = ranges < laser.max_range_m
    noisy = np.clip(ranges + rng.normal(0.0, settings.range_noise_m, ranges.shape), 0.0, laser.max_range_m)
    return np.where(hit & (rng.random(ranges.shape) >= settings.dropout), noisy, laser.max_range_m)
