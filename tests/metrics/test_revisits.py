"""Revisits counted by hand on straight paths."""

import numpy as np
import pytest

from fcslam.metrics.closures import WITHIN_GAP_S, find_revisits, recall_of
from fcslam.metrics.relations import PoseTable

STEP_M, STEP_S = 0.1, 0.2


def line(start, heading, metres):
    count = round(metres / STEP_M) + 1
    away = STEP_M * np.arange(count)[:, None] * (np.cos(heading), np.sin(heading))
    return np.column_stack((np.add(start, away), np.full(count, heading)))


def table(*paths):
    """One path a robot; all start at once."""
    counts = [len(path) for path in paths]
    stamps = np.concatenate([STEP_S * np.arange(count) + 0.001 * k for k, count in enumerate(counts)])
    return PoseTable.of(stamps, np.concatenate(paths), np.repeat(np.arange(len(paths)), counts))


def row_at(truth, robot, metres):
    return np.flatnonzero(truth.robots == robot)[round(metres / STEP_M)]


def test_side_by_side_every_metre_of_both_is_a_revisit():
    truth = table(line((0.0, 0.0), 0.0, 10.0), line((0.0, 1.5), 0.0, 10.0))
    passes, numbers = find_revisits(truth, between_robots=True)
    assert len(np.unique(numbers)) == len(passes) == 22
    first, second = passes.T
    assert np.all(truth.robots[first] != truth.robots[second])
    assert truth.T_map_base[first, 0] == pytest.approx(truth.T_map_base[second, 0])
    apart = table(line((0.0, 0.0), 0.0, 10.0), line((0.0, 2.1), 0.0, 10.0))
    assert len(find_revisits(apart, between_robots=True)[0]) == 0


@pytest.mark.parametrize(("heading", "count"), [(np.pi, 0), (np.radians(40.0), None), (-np.radians(50.0), 0)])
def test_like_headings_are_fewer(heading, count):
    truth = table(line((0.0, 0.0), 0.0, 10.0), line((5.0, 0.0), heading, 5.0))
    anyhow, _ = find_revisits(truth, between_robots=True)
    alike, _ = find_revisits(truth, between_robots=True, turn_deg=45.0)
    assert len(anyhow) > 0
    assert len(alike) == (len(anyhow) if count is None else count)


def test_a_robot_revisits_itself_only_after_a_while():
    there, back = line((0.0, 0.0), 0.0, 20.0), line((20.0, 0.0), np.pi, 20.0)
    truth = table(np.concatenate((there, back)))
    passes, _ = find_revisits(truth, between_robots=False)
    gap_s = np.abs(np.diff(truth.stamps[passes], axis=1))
    assert gap_s.min() > WITHIN_GAP_S
    # At x on the way there and x' on the way back 80.2 - 2 x - 2 x' seconds lie between; x' reaches down to x - 2.
    assert truth.T_map_base[passes[:, 0], 0].max() == pytest.approx(6.0)
    assert len(find_revisits(truth, between_robots=True)[0]) == 0


def test_one_of_several_passes_is_enough_and_both_ends_must_be_near():
    """Robot 1 drives the line of robot 0 there and back: two passes at each metre but those near its turn."""
    path = np.concatenate((line((0.0, 0.0), 0.0, 10.0), line((10.0, 0.0), np.pi, 10.0)))
    truth = table(line((0.0, 0.0), 0.0, 10.0), path)
    revisits = find_revisits(truth, between_robots=True)

    def found(*ends):
        correct = np.array([(row_at(truth, 0, a), row_at(truth, 1, b)) for a, b in ends], dtype=int).reshape(-1, 2)
        return recall_of(revisits, correct, truth)

    # robot 0 is asked at 11 places, robot 1 at 21; one number each, though 0's have two passes
    assert found().revisits == 11 + 21
    assert found().found == 0
    # places 4, 5, 6, 7 m of robot 0, and of robot 1 on its way there, or 13 to 16 m on its way back
    assert found((5.5, 5.5)).found == found((5.5, 14.5)).found == 4 + 4
    assert found((5.5, 5.5), (5.5, 14.5)).found == 4 + 4 + 4
    assert found((5.5, 1.5)).found == 0
