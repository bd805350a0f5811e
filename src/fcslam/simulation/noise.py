"""Measurement errors of a simulated LiDAR: range noise and dropouts."""

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.records import FloatArray, LaserModel


class LidarSettings(Settings):
    """The simulated LiDAR."""

    beams: int = Field(default=360, ge=8, description="beams of one scan of the LiDAR")
    field_of_view_rad: float = Field(
        default=2.0 * np.pi, gt=0.0, le=2.0 * np.pi, description="angle that a scan covers, centred ahead [rad]"
    )
    max_range_m: float = Field(default=12.0, gt=0.0, description="largest range of the LiDAR [m]")
    range_noise_m: float = Field(default=0.015, ge=0.0, description="standard deviation of a LiDAR range [m]")
    dropout: float = Field(
        default=0.01, ge=0.0, le=1.0, description="probability that a LiDAR beam that hits a surface returns nothing"
    )
    rate_hz: float = Field(default=5.0, gt=0.0, description="scan rate of the LiDAR [Hz]")

    def model(self, T_base_laser: tuple[float, float, float]) -> LaserModel:
        """Geometry and mounting; the first and the last beam of less than a full turn are its edges."""
        full = self.field_of_view_rad >= 2.0 * np.pi
        increment = self.field_of_view_rad / (self.beams if full else self.beams - 1)
        return LaserModel(self.beams, -0.5 * self.field_of_view_rad, increment, self.max_range_m, T_base_laser)


def simulate_ranges(
    ranges: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator
) -> FloatArray:
    """Add noise and dropouts to true ranges (..., beams) in metres; a dropout has ``laser.max_range_m``."""
    hit = ranges < laser.max_range_m
    noisy = np.clip(ranges + rng.normal(0.0, settings.range_noise_m, ranges.shape), 0.0, laser.max_range_m)
    return np.where(hit & (rng.random(ranges.shape) >= settings.dropout), noisy, laser.max_range_m)
