"""Where robots judge: who comes, goes, fails or lies makes no version better or worse."""

from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")

from fcslam.cli.federate import round_line
from fcslam.errors import InputError
from fcslam.learning.federated.evaluation import PUBLIC_IMAGES, VersionComparison, valid_metrics
from fcslam.learning.federated.fleets import InProcessFleet
from tests.learning.federated.fakes import START, Fake, rules, run, settings, shifted


def figures(value):
    return {"repeatability": value, "mma_3px": value}


@dataclass
class Judging(Fake):
    """Its figures are ``level``, and the better the further the weights have come, by ``slope`` for each 0.1."""

    level: float = 0.5
    slope: float = 0.01

    def evaluate(self, request):
        return figures(self.level + self.slope * 10.0 * float(request.weights["b.weight"] - START["b.weight"]))


class Coming(InProcessFleet):
    """Robots that are there from some round on."""

    def __init__(self, robots, since):
        super().__init__(robots)
        self._first, self._since = robots[0], since

    def robots(self):
        begun = len(self._first.asked)
        return [name for name, since in zip(super().robots(), self._since, strict=True) if begun >= since]


def run_coming(robots, since, folder, **given):
    return run(robots, folder, settings(**given), Coming(robots, since), evaluate_fn=None)


def test_only_some_rounds_are_judged_and_the_last(tmp_path):
    robots = [Judging("a")]
    state, reports = run(robots, tmp_path, settings(rounds=5), rules=rules(judge_every=2), evaluate_fn=None)
    assert [report.released for report in reports] == [False, True, False, True, True]
    assert [bool(report.metrics) for report in reports] == [False, True, False, True, True]
    assert state.best_round == 5
    assert "not judged" in round_line(reports[0].row(), 5)
    assert "released" in round_line(reports[1].row(), 5)


def test_the_median_robot_decides(tmp_path):
    robots = [Fake(f"r{index}", figures=figures(value)) for index, value in enumerate([0.2, 0.3, 0.4, 1.0, np.nan])]
    _, reports = run(robots, tmp_path, evaluate_fn=None)
    assert reports[0].metrics == pytest.approx(figures(0.35))
    assert reports[0].score == pytest.approx(0.35)


@pytest.mark.parametrize("level", [0.1, 0.9])
def test_robots_that_come_later_and_see_other_things_decide_by_what_they_gain(level, tmp_path):
    robots = [Judging("a"), Judging("b", level=level), Judging("c", level=level)]
    state, reports = run_coming(robots, [0, 2, 2], tmp_path, rounds=4)
    assert [(report.released, report.returned) for report in reports] == [(True, False)] * 4
    assert state.best_scores.keys() == {"a", "b", "c"}


def test_a_version_is_worse_even_if_easy_judges_have_come(tmp_path):
    robots = [Judging("a", slope=-0.01), Judging("b", level=0.9, slope=-0.01), Judging("c", level=0.9, slope=-0.01)]
    state, reports = run_coming(robots, [0, 2, 2], tmp_path, rounds=4)
    assert [report.released for report in reports] == [False] * 4
    assert state.best_round == 0


@pytest.mark.parametrize("lie", [{"repeatability": 1e6, "mma_3px": 1e6}, {"round": 1e9}, {}, figures(-0.5)])
def test_what_cannot_be_a_share_does_not_count(lie, tmp_path):
    state, reports = run([Judging("a"), Fake("liar", figures=lie)], tmp_path, evaluate_fn=None)
    assert state.best_scores.keys() == {"a"}
    assert all(report.row()["round"] == str(report.round_number) for report in reports)


def test_nobody_who_can_judge_is_waited_for_and_is_no_collapse(tmp_path):
    class Sick(Judging):
        asked_to_judge = 0

        def evaluate(self, request):
            self.asked_to_judge += 1
            if self.asked_to_judge in (1, 3, 4):
                raise InputError("the disk is gone")
            return super().evaluate(request)

    waited = []
    state, reports = run([Sick("a")], tmp_path / "waits", evaluate_fn=None, wait=waited.append)
    assert waited == ["a: the disk is gone"] * 3
    assert [(report.released, report.returned) for report in reports] == [(True, False)] * 2
    assert state.rounds_done == 2
    with pytest.raises(InputError, match="the disk is gone"):
        run([Sick("a")], tmp_path / "ends", evaluate_fn=None)


def test_a_run_that_robots_judged_goes_on_with_public_images(tmp_path):
    run([Judging("a")], tmp_path, settings(rounds=2), evaluate_fn=None)

    def judge(weights):
        return figures(0.9 + 0.1 * float(weights["b.weight"] - START["b.weight"]))

    state, reports = run([Judging("a")], tmp_path, settings(rounds=4), evaluate_fn=judge)
    assert [report.released for report in reports] == [True, True]
    assert state.best_scores == {PUBLIC_IMAGES: pytest.approx(0.94)}


def test_a_robot_that_only_fails_to_judge_the_best_is_named(tmp_path):
    class Late(Judging):
        def evaluate(self, request):
            if request.weights["b.weight"] < START["b.weight"] + 0.25:
                raise InputError("too dark")
            return super().evaluate(request)

    _, reports = run_coming([Judging("a", slope=-0.01), Late("b", slope=-0.01)], [0, 2], tmp_path, rounds=4)
    assert reports[2].left_out == {"judging by b": "too dark"}
    assert not any(report.released for report in reports)


def test_one_that_has_judged_neither_decides_nothing():
    assert VersionComparison({"a": figures(0.5)}, {"b": 0.4}).gain is None
    assert VersionComparison({"a": figures(0.5), "b": figures(0.1)}, {"b": 0.4}).gain == pytest.approx(-0.3)
    assert valid_metrics(figures(0.3) | {"round": 3.0}) == figures(0.3)


def test_all_weights_move_as_told(tmp_path):
    state, _ = run([Judging("a", by=0.5)], tmp_path, evaluate_fn=None)
    assert np.allclose(state.weights["a.weight"], shifted(START, 1.0)["a.weight"])
