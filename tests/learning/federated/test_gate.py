"""The release gate by scripted reports: when a version is released."""

import numpy as np
import pytest

from fcslam.learning.federated.evaluation import gate
from fcslam.learning.federated.held_out import COLUMNS, MOST_PAIRS, check_judgement

PAIRS = 80
"""Of each of three robots: 240 in all."""


def reports(recall=0.0, found=0.9, pairs=PAIRS, robots=3, noise=0.02, seed=1):
    """Reports of robots whose recall is 0.5 and ``recall`` more."""
    rng, places = np.random.default_rng(seed), np.random.default_rng(9)
    return {
        f"robot_{k}": np.column_stack(
            (np.clip(0.5 + recall + noise * rng.standard_normal(pairs), 0, 1), places.random(pairs) < found)
        ).astype(np.float32)
        for k in range(robots)
    }


def decided(candidate, released, fewest_pairs=200):
    return gate(candidate, released, fewest_pairs, 1)


def test_a_better_version_is_released_with_its_figures():
    decision = decided(reports(0.05, seed=2), reports())
    assert decision.released
    assert decision.metrics["pairs"] == 240
    assert decision.metrics["revisit_recall_gain"] == decision.gain == pytest.approx(0.05, abs=0.01)
    assert decision.metrics["revisit_recall"] == decision.score == pytest.approx(0.55, abs=0.01)


@pytest.mark.parametrize("recall", [0.0, -0.05])
def test_a_version_that_is_not_better_is_not_released(recall):
    decision = decided(reports(recall), reports())
    assert not decision.released
    assert "not better on held-out pairs" in decision.reason


def test_fewer_pairs_than_200_release_nothing_and_the_reason_says_so():
    fewer = decided(reports(0.3, pairs=66, seed=2), reports(pairs=66))
    assert not fewer.released
    assert fewer.reason == "198 held-out pairs, 200 needed"
    assert decided(reports(0.3, pairs=66, seed=2), reports(pairs=66), fewest_pairs=198).released
    assert decided({}, {}).reason == "0 held-out pairs, 200 needed"


def test_a_version_that_may_find_fewer_places_is_not_released():
    decision = decided(reports(0.05, found=0.7, seed=2), reports(found=0.9))
    assert not decision.released
    assert "may find fewer places" in decision.reason


def test_without_two_different_places_nothing_is_released():
    new, old = reports(0.05, seed=2), reports()
    for rows in (*new.values(), *old.values()):
        rows[:, 1] = np.nan
    assert decided(new, old).reason == "no robot knows two different places to compare"


def test_one_robot_that_lies_does_not_release_a_version():
    """It claims that its own pairs were all lost before and are all found now."""
    new, old = reports(-0.01, seed=2), reports()
    new["robot_0"][:], old["robot_0"][:] = 1.0, 0.0
    decision = decided(new, old)
    assert decision.gain > 0.2, "its claim alone would do"
    assert not decision.released
    assert decision.reason == "not better for most robots"


def test_only_robots_count_that_judged_both_versions_on_the_same_pairs():
    new, old = reports(0.05, robots=4, seed=2), reports(robots=4)
    del old["robot_3"]
    new["robot_2"] = new["robot_2"][:-1]
    assert decided(new, old).metrics["pairs"] == 160


GOOD = np.array([[0.5, 1.0], [1.0, np.nan]], np.float32)


@pytest.mark.parametrize(
    "report",
    [
        None,
        GOOD.tolist(),
        GOOD.astype(np.float64),
        GOOD[0],
        GOOD[:, :1],
        np.zeros((MOST_PAIRS + 1, len(COLUMNS)), np.float32),
        GOOD * 2,
        GOOD * np.nan,
        -GOOD,
        np.array([[0.5, 0.5]], np.float32),
        np.array([[np.inf, 1.0]], np.float32),
    ],
)
def test_a_report_that_no_robot_can_have_made_is_refused(report):
    assert check_judgement(GOOD) is GOOD
    with pytest.raises(ValueError, match="report on pairs"):
        check_judgement(report)
