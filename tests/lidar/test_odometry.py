"""Trust in odometry follows how far it was right; slips hardly change it."""

import numpy as np
import pytest

from fcslam.lidar.odometry import LEAST_TRUST, OdometryError, OdometryTrust

MODEL = OdometryError(0.05, 0.03)


def learned(innovations):
    trust = OdometryTrust()
    for innovation in innovations:
        trust = trust.learn(innovation, MODEL)
    return trust


def innovations(rng, position, heading, count=600):
    return rng.normal(size=(count, 3)) * (position * 0.05, position * 0.05, heading * 0.03)


def test_translation_and_rotation_are_learned_separately():
    trust = learned(innovations(np.random.default_rng(1), position=0.3, heading=1.5))
    # The scale of a t distribution differs from the standard deviation of the normal one that it is fitted to.
    assert 0.5 < trust.position / 0.3 < 1.3
    assert 0.5 < trust.heading / 1.5 < 1.3
    assert trust.matches == 600


def test_slips_are_outliers():
    rng = np.random.default_rng(2)
    good = innovations(rng, position=0.3, heading=0.3)
    slips = np.where(rng.random(len(good)) < 0.05, 1.0, 0.0)[:, None] * (0.7, 0.0, 0.2)
    clean, slipping = learned(good), learned(good + slips)
    assert slipping.position < 1.3 * clean.position
    assert slipping.heading < 1.3 * clean.heading


def test_odometry_that_gets_worse_loses_trust():
    rng = np.random.default_rng(3)
    trust = learned(np.vstack((innovations(rng, 0.2, 0.2), innovations(rng, 2.0, 2.0, count=1000))))
    assert min(trust.position, trust.heading) > 0.6


def test_trust_in_perfect_odometry_is_bounded():
    trust = learned(np.zeros((2000, 3)))
    assert trust.position == trust.heading == LEAST_TRUST


@pytest.mark.parametrize("slips", [0.0, 0.05])
def test_the_ratios_of_distance_and_turn_are_learned(slips):
    """Wheels of another radius and another distance between them; slips are outliers."""
    rng, trust = np.random.default_rng(4), OdometryTrust()
    true = np.column_stack((rng.uniform(0.0, 0.1, 800), np.zeros(800), rng.normal(0.0, 0.1, 800)))
    measured = true * (1.04, 1.0, 0.96) + (rng.random((800, 1)) < slips) * (0.08, 0.0, 0.1)
    for moved, odometry in zip(true, measured, strict=True):
        innovation = moved - trust.motion(tuple(odometry)) + rng.normal(0.0, 0.003, 3)
        trust = trust.learn(innovation, OdometryError(0.04, 0.03), tuple(odometry))
    assert trust.distance.value == pytest.approx(1.0 / 1.04, abs=0.01)
    assert trust.turn.value == pytest.approx(1.0 / 0.96, abs=0.01)


def test_the_likelihood_has_heavy_tails():
    """Ten standard deviations cost a few nats, not fifty: clear scans must be able to overrule odometry."""
    assert MODEL.log_likelihood(np.zeros(3)) == 0.0
    near, far = (MODEL.log_likelihood(np.array((k * 0.05, 0.0, 0.0))) for k in (1.0, 10.0))
    assert -15.0 < far < near < 0.0
    assert MODEL.mahalanobis2(np.array((0.05, 0.05, -0.03))) == pytest.approx(3.0)
