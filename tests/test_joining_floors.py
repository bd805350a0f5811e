"""Floors of one building whose maps contradict each other stay apart, however many places agree."""

import numpy as np
import pytest

from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import ReasonCode
from fcslam.runs import separations
from tests.flats import Drive
from tests.lidar.worlds import box, path

pytestmark = pytest.mark.slow

LEFT = [(1.0, 1.0), (6.8, 1.2), (6.6, 4.8), (1.2, 5.0), (1.2, 2.6), (6.9, 3.0)]
"""Through the left room, and to the door of the right one."""


def storey(off_m):
    """Two rooms with furniture; the right one lies ``off_m`` farther up."""
    left = path((8, 2.6), (8, 0), (0, 0), (0, 6), (8, 6), (8, 3.4))
    right = path((8, 2.6), (8, 0 + off_m), (16, 0 + off_m), (16, 6 + off_m), (8, 6 + off_m), (8, 3.4))
    boxes = [
        (2.4, 2.0, 1.1, 0.6),
        (4.6, 0.1, 0.9, 0.5),
        (3.0, 5.3, 1.4, 0.6),
        (0.1, 3.4, 0.5, 0.9),
        (5.0, 3.2, 0.6, 0.6),
    ]
    beyond = [(11.0, 2.2, 0.8, 1.4), (14.8, 0.3, 1.1, 0.7), (12.6, 5.2, 1.6, 0.7), (9.0, 0.2, 0.7, 0.7)]
    moved = [(x, y + off_m, width, depth) for x, y, width, depth in beyond]
    return np.vstack((left, right, *(box(x, y, x + width, y + depth) for x, y, width, depth in (*boxes, *moved))))


def way(off_m):
    """A drive through both rooms and back."""
    right = [(9.0, 3.0), (10.2, 3.0 + off_m), (10.2, 1.2 + off_m), (13.6, 1.0 + off_m), (15.0, 3.6 + off_m)]
    return [*LEFT, *right, (10.4, 5.0 + off_m), (9.4, 3.0), (7.2, 3.0), (6.8, 1.2)]


def mapped(*offsets_m):
    drives = [
        Drive(name, way(off_m), storey(off_m), seed)
        for seed, (name, off_m) in enumerate(zip("ab", offsets_m, strict=True))
    ]
    return run_mission(drives, MissionConfig())


def test_floors_that_are_equal_in_part_stay_apart():
    """The left rooms are equal, and all closures there are right; the walls of the right ones contradict."""
    run = mapped(0.0, 1.5)
    assert {trajectory.map_index for trajectory in run.trajectories.values()} == {0, 1}
    (apart,) = separations(run)
    assert apart.reason.code is ReasonCode.MAPS_CONTRADICT
    assert run.joins == ()


def test_one_floor_is_one_map_and_its_evidence_is_said():
    run = mapped(0.0, 0.0)
    assert {trajectory.map_index for trajectory in run.trajectories.values()} == {0}
    (join,) = run.joins
    assert (join.robot_i, join.robot_j) == ("a", "b")
    assert join.places >= 3
    assert join.seen_m > 30.0
    assert join.contradicting_m < 0.005 * join.seen_m
    assert join.likeness > 0.7
    assert "m of wall seen by both, 0.0 m (0.0 %) contradict" in str(join)
