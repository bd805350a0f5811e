"""Which updates are refused: poison of every kind is, and honest robots that differ are not."""

import numpy as np
import pytest

from fcslam.learning.federated.screening import BOUNDS, ScreeningBounds, screen, update_length

RNG = np.random.default_rng(4)
BEFORE = {
    "convolution.weight": RNG.normal(size=(400, 300)).astype(np.float32),
    "norm.running_mean": np.zeros(20, np.float32),
    "norm.running_var": np.ones(20, np.float32),
}
COMMON = RNG.normal(size=BEFORE["convolution.weight"].shape)


def honest(seed, share=0.4):
    """A robot that shares a part of its direction with the others, and has one of its own."""
    own = np.random.default_rng(seed).normal(size=COMMON.shape)
    step = share * COMMON + np.sqrt(1 - share**2) * own
    return BEFORE | {"convolution.weight": (BEFORE["convolution.weight"] + 0.02 * step).astype(np.float32)}


def poisoned(kind):
    good = honest(99)["convolution.weight"] - BEFORE["convolution.weight"]
    update = {
        "flipped": -good,
        "scaled": 30.0 * good,
        "random": np.random.default_rng(7).normal(size=good.shape) * good.std(),
        "huge": np.random.default_rng(7).normal(size=good.shape) * 1e3,
        "nan": np.where(good > 0, np.nan, good),
        "zero": np.zeros_like(good),
    }[kind]
    return BEFORE | {"convolution.weight": (BEFORE["convolution.weight"] + update).astype(np.float32)}


STRICT = ScreeningBounds(least_agreement=0.01)
"""Refuses what agrees with nobody as well, which does less harm than honest robots' being refused after short legs."""


@pytest.mark.parametrize(
    ("kind", "settings"),
    [(kind, BOUNDS) for kind in ("flipped", "scaled", "huge", "nan")] + [(kind, STRICT) for kind in ("random", "zero")],
)
def test_one_poisoned_robot_of_five_is_refused_and_no_other(kind, settings):
    answers = {f"robot{seed}": honest(seed) for seed in range(4)} | {"bad": poisoned(kind)}
    refused = screen(answers, BEFORE, settings)
    assert set(refused) == {"bad"}
    assert refused["bad"]


def test_a_majority_of_long_updates_is_refused_by_the_lengths_of_the_round_before():
    good = honest(99)["convolution.weight"] - BEFORE["convolution.weight"]
    long = BEFORE | {"convolution.weight": (BEFORE["convolution.weight"] - 10.0 * good).astype(np.float32)}
    answers = {f"robot{seed}": honest(seed) for seed in range(2)} | dict.fromkeys(("bad1", "bad2", "bad3"), long)
    usual = update_length({"a": honest(1), "b": honest(2)}, BEFORE)
    assert set(screen(answers, BEFORE, BOUNDS, earlier_length=usual)) == {"bad1", "bad2", "bad3"}
    assert set(screen(answers, BEFORE, BOUNDS)) == {"robot0", "robot1"}, "the round alone cannot know"


def test_the_round_before_sets_no_bound_where_all_updates_are_longer():
    answers = {f"robot{seed}": honest(seed) for seed in range(5)}
    usual = update_length(answers, BEFORE)
    assert not screen(answers, BEFORE, BOUNDS, earlier_length=0.01 * usual)
    assert update_length({}, BEFORE) == 0.0


@pytest.mark.parametrize(("kind", "settings"), [("flipped", BOUNDS), ("random", STRICT), ("scaled", BOUNDS)])
def test_poison_does_not_hide_behind_honest_statistics(kind, settings):
    """These may be longer than all else by far, and equal, because all robots see other things than the start saw."""

    def in_daylight(weights):
        return weights | {
            "norm.running_mean": np.full(20, 40.0, np.float32),
            "norm.running_var": np.full(20, 50.0, np.float32),
        }

    start = BEFORE | {"norm.running_mean": np.full(20, 90.0, np.float32)}
    answers = {f"robot{seed}": in_daylight(honest(seed)) for seed in range(4)} | {"bad": in_daylight(poisoned(kind))}
    assert set(screen(answers, start, settings)) == {"bad"}


def test_statistics_may_lie_on_all_sides_but_not_far_away():
    def lit(seed, by):
        return honest(seed) | {"norm.running_mean": np.full(20, by, np.float32)}

    answers = {f"robot{seed}": lit(seed, by) for seed, by in enumerate([0.1, -0.1, 0.12, -0.12])}
    assert screen(answers, BEFORE, BOUNDS) == {}
    assert set(screen(answers | {"bad": lit(9, 5.0)}, BEFORE, BOUNDS)) == {"bad"}


@pytest.mark.parametrize("kind", ["huge", "nan"])
@pytest.mark.parametrize("others", [0, 1, 2])
def test_even_few_robots_are_safe_from_what_nobody_could_mean(kind, others):
    answers = {f"robot{seed}": honest(seed) for seed in range(others)} | {"bad": poisoned(kind)}
    assert set(screen(answers, BEFORE, BOUNDS)) == {"bad"}


def test_two_that_disagree_are_not_judged():
    answers = {"a": honest(1), "b": poisoned("flipped")}
    assert screen(answers, BEFORE, BOUNDS) == {}


def seen(seed, **changed):
    """An honest robot in light of its own."""
    rng = np.random.default_rng(seed)
    means, variances = rng.normal(0.0, 0.1, 200), np.exp(rng.normal(0.0, 0.2, 200))
    statistics = {"norm.running_mean": means, "norm.running_var": variances} | changed
    return honest(seed) | {name: array.astype(np.float32) for name, array in statistics.items()}


LIT = BEFORE | {"norm.running_mean": np.zeros(200, np.float32), "norm.running_var": np.ones(200, np.float32)}


@pytest.mark.parametrize("robots", [2, 3, 7])
@pytest.mark.parametrize(
    "falsify",
    [
        lambda array: 3.0 * array,
        lambda array: array / 3.0,
        np.zeros_like,
        lambda array: np.where(np.arange(len(array)) == 5, 1e4 * array, array),
        lambda array: np.where(np.arange(len(array)) < 100, 6.0 * array, array),
    ],
)
def test_false_variances_are_refused(falsify, robots):
    """By their length or by their distance from those of the others."""
    answers = {f"robot{seed}": seen(seed) for seed in range(robots)}
    assert screen(answers, LIT, BOUNDS) == {}
    true = seen(99)["norm.running_var"]
    refused = screen(answers | {"bad": seen(99, **{"norm.running_var": falsify(true)})}, LIT, BOUNDS)
    assert set(refused) == {"bad"}


def test_a_flipped_update_takes_no_honest_robot_with_it():
    """With four robots, the flipped update is a third of what an honest one is compared with."""
    for seed in range(0, 40, 4):
        answers = {f"robot{number}": honest(seed + number, share=0.35) for number in range(3)}
        update = honest(seed + 3, share=0.35)["convolution.weight"] - BEFORE["convolution.weight"]
        flipped = BEFORE | {"convolution.weight": BEFORE["convolution.weight"] - update}
        assert set(screen(answers | {"bad": flipped}, BEFORE, BOUNDS)) == {"bad"}


def test_two_flipped_updates_of_six_are_refused_and_no_other():
    answers = {f"robot{seed}": honest(seed) for seed in range(4)}
    for name, seed in (("bad", 98), ("worse", 99)):
        update = honest(seed)["convolution.weight"] - BEFORE["convolution.weight"]
        answers[name] = BEFORE | {"convolution.weight": BEFORE["convolution.weight"] - update}
    assert set(screen(answers, BEFORE, BOUNDS)) == {"bad", "worse"}
