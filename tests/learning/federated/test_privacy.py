"""Clipping and noise, and whether the accountant promises what the noise keeps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.stats import norm

from fcslam.learning.federated.privacy import clip_update, epsilon, privatise_update
from fcslam.learning.federated.settings import PrivacySettings
from fcslam.learning.federated.weights import update_vector

BEFORE = {"weight": np.zeros((100, 200), np.float32), "running_mean": np.ones(5, np.float32)}


def exact_epsilon(noise_multiplier, rounds, delta):
    """Of the Gaussian mechanism (Balle and Wang 2018, theorem 8), by its hypothesis test and not by any bound.

    Rounds of Gaussians with sensitivity 2 are one Gaussian with sensitivity 2 sqrt(rounds).
    """
    mu = 2.0 * np.sqrt(rounds) / noise_multiplier

    def excess(eps):
        return norm.cdf(mu / 2 - eps / mu) - np.exp(eps + norm.logcdf(-mu / 2 - eps / mu)) - delta

    return brentq(excess, 0.0, 1e5) if excess(0.0) > 0 else 0.0


@pytest.mark.parametrize("noise_multiplier", [0.3, 1.0, 4.0, 20.0, 100.0])
@pytest.mark.parametrize("rounds", [1, 10, 100])
@pytest.mark.parametrize("delta", [1e-3, 1e-5, 1e-8])
def test_epsilon_is_never_below_the_exact_one_and_close_to_it(noise_multiplier, rounds, delta):
    exact = exact_epsilon(noise_multiplier, rounds, delta)
    promised = epsilon(noise_multiplier, rounds, delta)
    assert exact <= promised <= 1.15 * exact + 0.1


def test_the_textbook_value():
    """A Gaussian as wide as its sensitivity, at delta 1e-5: 4.377 (Balle and Wang 2018)."""
    assert exact_epsilon(2.0, 1, 1e-5) == pytest.approx(4.377, abs=1e-3)


def test_no_noise_promises_nothing_and_no_rounds_give_nothing_away():
    assert epsilon(0.0, 1, 1e-5) == np.inf
    assert epsilon(0.0, 0, 1e-5) == 0.0
    assert epsilon(1.0, 2, 1e-5) > epsilon(1.0, 1, 1e-5) > epsilon(2.0, 1, 1e-5)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(0.01, 100.0))
def test_what_is_clipped_is_no_longer_than_allowed_and_points_where_it_did(values, limit):
    update = np.array(values)
    short = clip_update(update, limit)
    assert np.linalg.norm(short) <= limit * (1 + 1e-9)
    assert np.linalg.norm(short) == pytest.approx(min(np.linalg.norm(update), limit))
    assert short * np.linalg.norm(update) == pytest.approx(update * np.linalg.norm(short), abs=1e-6)


@pytest.mark.parametrize("length", [0.0, 0.5, 50.0])
def test_what_leaves_is_the_clipped_update_and_noise_of_the_right_size(length):
    after = {
        "weight": np.full((100, 200), length / np.sqrt(20_000), np.float32),
        "running_mean": np.full(5, 9, np.float32),
    }
    chosen = PrivacySettings(clip_norm=2.0, noise_multiplier=3.0)
    sent = privatise_update(after, BEFORE, ["weight"], chosen, np.random.default_rng(1))
    noise = update_vector(sent, BEFORE, ["weight"]) - clip_update(update_vector(after, BEFORE, ["weight"]), 2.0)
    assert noise.std() == pytest.approx(6.0, rel=0.03)
    assert abs(noise.mean()) < 0.2
    assert np.array_equal(sent["running_mean"], BEFORE["running_mean"])


def test_without_noise_the_weights_leave_as_they_are():
    after = {"weight": np.full((100, 200), 7, np.float32), "running_mean": np.zeros(5, np.float32)}
    sent = privatise_update(after, BEFORE, ["weight"], PrivacySettings(clip_norm=0.1), np.random.default_rng(1))
    assert all(np.array_equal(sent[name], after[name]) for name in after)
