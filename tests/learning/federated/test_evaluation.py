"""Versions that are evaluated on images, by the server or by each robot on its own."""

import math

import pytest

from fcslam.cli.federate import round_line
from fcslam.learning.federated.evaluation import compare
from tests.learning.federated.fakes import Fake, rules, run, settings


def figures(value):
    return {"repeatability": value, "mma_3px": value}


def test_only_some_rounds_are_judged_and_the_last(tmp_path):
    state, reports = run([Fake("a")], tmp_path, settings(rounds=5), rules=rules(judge_every=2))
    assert [report.released for report in reports] == [False, True, False, True, True]
    assert [bool(report.evaluation.metrics) for report in reports] == [False, True, False, True, True]
    assert state.best_round == 5
    assert "not judged" in round_line(reports[0].row(), 5)
    assert "released" in round_line(reports[1].row(), 5)


def test_a_run_goes_on_with_other_images(tmp_path):
    run([Fake("a")], tmp_path, settings(rounds=2))
    state, reports = run([Fake("a")], tmp_path, settings(rounds=4), score=lambda weights: float(weights["b.weight"]))
    assert [report.released for report in reports] == [True, True]
    assert state.best_round == 4


def test_the_median_robot_decides():
    found = compare({f"r{index}": figures(value) for index, value in enumerate([0.2, 0.3, 0.4, 1.0, 0.35])}, {})
    assert found.metrics == pytest.approx(figures(0.35))
    assert found.score == pytest.approx(0.35)


@pytest.mark.parametrize(("slope", "released"), [(0.01, True), (0.0, True), (-0.01, False)])
def test_differences_at_the_same_robot_are_compared(slope, released):
    """Robots see other things, so the levels of their scores differ."""
    before = {"easy": 0.9, "hard": 0.1, "other": 0.5}
    after = {name: figures(score + slope) for name, score in before.items()}
    found = compare(after | {"new": figures(0.99)}, before)
    assert found.gain == pytest.approx(slope)
    assert found.released is released


@pytest.mark.parametrize("found", [{}, {"a": figures(0.5)}])
def test_one_that_has_judged_neither_decides_nothing(found):
    assert math.isnan(compare(found, {"b": 0.4}).gain)
    assert not compare(found, {"b": 0.4}).released


def test_a_version_that_finds_nothing_is_the_worst():
    assert compare({"a": figures(math.nan)}, {"a": 0.0}).gain == -1.0
