"""Beams and measurement errors of a simulated LiDAR."""

from typing import Final

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.lab.simulation.options import Scanner
from fcslam.records import Beams, FloatArray, LaserModel, Sweep


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
    spin: int = Field(
        default=0,
        ge=-1,
        le=1,
        description="1: the LiDAR spins counter-clockwise and measures each beam at its own time; -1: clockwise; "
        "0: it measures all beams of a scan at once",
    )

    def model(self, T_base_laser: tuple[float, float, float]) -> LaserModel:
        """Geometry of the laser, mounted at ``T_base_laser``.

        The first and the last beam of less than a full turn are its edges.
        """
        full = self.field_of_view_rad >= 2.0 * np.pi
        increment = self.field_of_view_rad / (self.beams if full else self.beams - 1)
        return LaserModel(self.beams, -0.5 * self.field_of_view_rad, increment, self.max_range_m, T_base_laser)

    def sweep(self, beams: Beams) -> Sweep | None:
        """Times of the beams of a scan, whose stamp is that of the first one measured; None if it has all at once."""
        if not self.spin:
            return None
        duration_s = beams.span_rad / (2.0 * np.pi * self.rate_hz)
        return Sweep(0.0, duration_s) if self.spin > 0 else Sweep(duration_s, 0.0)


SCANNERS: Final = {
    Scanner.INSTANT: LidarSettings(rate_hz=10.0),
    Scanner.RPLIDAR_A1: LidarSettings(beams=1454, rate_hz=5.5, range_noise_m=0.02, dropout=0.03, spin=-1),
    Scanner.LD19: LidarSettings(beams=450, rate_hz=10.0, range_noise_m=0.015, dropout=0.02, spin=-1),
    Scanner.UTM_30LX: LidarSettings(
        beams=1081,
        field_of_view_rad=1.5 * np.pi,
        max_range_m=30.0,
        range_noise_m=0.01,
        dropout=0.005,
        rate_hz=40.0,
        spin=1,
    ),
}
"""The settings of each scanner."""


def simulate_ranges(
    ranges: FloatArray, laser: LaserModel, settings: LidarSettings, rng: np.random.Generator
) -> FloatArray:
    """Add noise and dropouts to true ranges (..., beams) in metres; a dropout has ``laser.max_range_m``."""
    hit = ranges < laser.max_range_m
    noisy = np.clip(ranges + rng.normal(0.0, settings.range_noise_m, ranges.shape), 0.0, laser.max_range_m)
    return np.where(hit & (rng.random(ranges.shape) >= settings.dropout), noisy, laser.max_range_m)
