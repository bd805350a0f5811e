"""Yards: what stands in them, what beams meet there, and walks that come home."""

import numpy as np
import pytest

from fcslam.errors import SimulationError
from fcslam.simulation.noise import LidarSettings
from fcslam.simulation.options import Building
from fcslam.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet

SICK = LidarSettings(beams=181, field_of_view_rad=np.pi, max_range_m=81.9, rate_hz=0.5)
TINY = SimulationSettings(building=Building.YARD, robots=2, path_length_m=60.0, camera=None, lidar=SICK)


def ranges(robot):
    return np.array([scan.ranges_m for scan in robot.scans()])


def test_the_same_seed_gives_the_same_scans_and_another_another():
    first, again, other = (ranges(simulate_fleet(TINY, seed).robots[1]) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or np.any(first != other)


def test_ranges_stay_below_the_maximum_and_some_beams_return_nothing():
    found = ranges(simulate_fleet(TINY, 3).robots[0])
    assert found.min() > 0.0
    assert found.max() <= np.float32(81.9)
    assert 0.4 < np.mean(found < 80.0) < 0.95


def test_a_yard_has_no_images():
    with pytest.raises(SimulationError, match=r"^a yard .* \(--no-camera\)$"):
        simulate_fleet(TINY.model_copy(update={"camera": CameraSettings()}), 1)
