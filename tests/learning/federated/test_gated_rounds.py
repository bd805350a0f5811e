"""Rounds behind the release gate: only a version that passes is released."""

import numpy as np
import pytest

from fcslam.config import changed
from fcslam.learning.federated.settings import FleetLearningSettings
from tests.learning.federated.fakes import START, Fake, rules, run, settings, version

TRAINED = {name: array for name, array in START.items() if name != "a.running_var"}


def judge(name, likes=1.0, pairs=100):
    """A robot that finds the more, the larger the first weight is, times ``likes``."""

    def report(weights):
        rng = np.random.default_rng(1)
        recall = 0.3 + 0.1 * likes * (float(weights["a.weight"][0, 0]) - 1.0) + 0.01 * rng.random(pairs)
        return np.column_stack((recall, rng.random(pairs) < 0.8)).astype(np.float32)

    return Fake(name, judge=report)


def gated(robots, folder, rounds=2, **hooks):
    given = {"rules": rules(fewest_pairs=200), **hooks}
    return run(robots, folder, settings(rounds=rounds), start=TRAINED, **given)


def test_a_version_that_passes_is_released(tmp_path):
    state, reports = gated([judge(f"r{k}") for k in range(3)], tmp_path)
    assert [report.released for report in reports] == [True, True]
    assert state.best_round == 2
    assert reports[0].evaluation.metrics["pairs"] == 300.0
    assert reports[0].evaluation.metrics["revisit_recall_gain"] == pytest.approx(0.01, abs=1e-4)
    assert reports[0].row()["reason"] == "better on held-out pairs"


def test_a_robot_whose_report_is_no_report_does_not_count(tmp_path):
    liar = Fake("r2", judge=lambda _weights: np.full((500, 2), 7.0, np.float32))
    _, reports = gated([judge("r0"), judge("r1"), liar], tmp_path)
    assert reports[0].evaluation.metrics["pairs"] == 200.0
    assert "numbers that no pair can have" in reports[0].left_out["judging by r2"]


def test_a_release_survives_a_kill_between_the_checkpoint_and_its_announcement(tmp_path):
    fleet, released = [judge(f"r{k}") for k in range(3)], []

    def killed(_weights):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gated(fleet, tmp_path, rounds=1, on_release=killed)
    state, reports = gated(fleet, tmp_path, rounds=1, on_release=released.append)
    assert not reports, "the round is done"
    assert [version(weights) for weights in released] == [version(state.best)]
    assert state.best_round == 1


def test_one_setting_of_training_leaves_the_others_of_the_recipe():
    settings = changed(FleetLearningSettings(), {"federated": {"training": {"seed": 2}}}, "learning.yaml")
    assert settings.federated.training.seed == 2
    assert settings.federated.training.learning_rate == FleetLearningSettings().federated.training.learning_rate == 1e-3
