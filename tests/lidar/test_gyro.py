"""The gyro of a robot without wheels: turns between any times, its bias, and a gyro that measures something else."""

import numpy as np
import pytest

from fcslam.lidar.gyro import Gyro, integral
from fcslam.records import LaserModel, LaserScan, Sweep

LASER = LaserModel(4, -np.pi, np.pi / 2, 10.0)


def scan(stamp: float, begin_s: float, rate: object, bias: float = 0.0) -> LaserScan:
    times = np.arange(begin_s, stamp + 0.25, 0.01)
    readings = np.column_stack((times, [rate(t) + bias for t in times]))  # type: ignore[operator]
    return LaserScan(stamp, np.ones(4, np.float32), LASER, np.full(3, np.nan), gyro=readings)


def test_the_integral_of_a_rate_that_grows_is_exact_between_readings() -> None:
    stamps = np.arange(0.0, 2.0, 0.1)
    times = np.array([0.34, 0.5, 1.27])
    found = integral(stamps, stamps[:, None], times)
    assert found[:, 0] == pytest.approx(0.5 * (times**2 - times[0] ** 2), abs=2e-3)


def test_a_sweep_gets_the_turn_in_it_in_either_direction() -> None:
    gyro = Gyro()
    gyro.add(scan(1.0, 0.0, lambda t: 2.0 * t))
    for first_s, last_s in ((0.0, 0.2), (0.2, 0.0), (-0.2, 0.0)):
        sweep = gyro.turning(Sweep(first_s, last_s, (0.3, 0.0, 0.0)), 1.0)
        assert sweep.velocity == pytest.approx((0.3, 0.0, 2.0), abs=0.01)
        assert sweep.acceleration[2] == pytest.approx(2.0, abs=0.05)
        assert sweep.displacement(0.15)[2] == pytest.approx(1.15**2 - 1.0, abs=2e-3)


def test_the_bias_is_learned_from_matched_scans() -> None:
    gyro = Gyro()
    for number in range(1, 60):
        stamp = 0.2 * number
        gyro.add(scan(stamp, stamp - 0.2 if number > 1 else 0.0, np.sin, bias=0.05))
        if number > 1:
            gyro.learn(stamp - 0.2, stamp, float(np.cos(stamp - 0.2) - np.cos(stamp)))
    angles = gyro.angles(np.array([stamp - 0.2, stamp]))
    assert angles is not None
    assert angles[1] == pytest.approx(np.cos(stamp - 0.2) - np.cos(stamp), abs=1e-3)


def test_a_gyro_that_contradicts_the_scans_is_not_used() -> None:
    gyro = Gyro()
    for number in range(1, 30):
        stamp = 0.2 * number
        gyro.add(scan(stamp, stamp - 0.2 if number > 1 else 0.0, lambda _: 3.0))
        if number > 1:
            gyro.learn(stamp - 0.2, stamp, -0.4 * (-1.0) ** number)
    assert gyro.angles(np.array([stamp - 0.2, stamp])) is None


def test_times_without_readings_are_unknown() -> None:
    gyro = Gyro()
    assert gyro.angles(np.array([0.0, 0.1])) is None
    gyro.add(scan(1.0, 0.0, lambda _: 1.0))
    assert gyro.angles(np.array([0.8, 2.0])) is None
