"""A closure by hand: the walls say where, as far as the user's tolerance allows."""

import numpy as np
import pytest

from fcslam.cloud.decisions import measured
from fcslam.geometry import se2
from fcslam.records import ManualClosure
from tests.lidar.test_submap_verification import EAST, WEST
from tests.lidar.worlds import other_room, room, scan_at

OFF = (0.25, -0.2, 0.08)


def scans_along(waypoints, walls, seed):
    """Scans of a drive with poses in the base of its middle pose, and that pose."""
    rng, poses = np.random.default_rng(seed), [np.array(pose) for pose in waypoints]
    anchor = poses[len(poses) // 2]
    return [(scan_at(pose, walls, noise_m=0.01, rng=rng), se2.between(anchor, pose)) for pose in poses], anchor


@pytest.mark.parametrize(
    ("walls", "tolerance", "is_refined"),
    [(room, (0.5, 0.1), True), (room, (0.01, 0.01), False), (other_room, (0.5, 0.1), False)],
    ids=["rough", "sure", "another room"],
)
def test_walls_that_fit_within_the_tolerance_refine_it(walls, tolerance, is_refined):
    (i, at_i), (j, at_j) = scans_along(WEST, room(), 0), scans_along(EAST, walls(), 1)
    truth = se2.between(at_i, at_j)
    given = se2.compose(truth, OFF)
    made = ManualClosure("a", 0.0, "b", 0.0, tuple(given.tolist()), tolerance)
    T_i_j, information = measured(made, i, j)
    off_m = np.hypot(*se2.between(truth, T_i_j)[:2])
    if is_refined:
        assert off_m < 0.03
    else:
        assert T_i_j == pytest.approx(given, abs=0.0)
        assert np.diag(information) == pytest.approx([tolerance[0] ** -2, tolerance[0] ** -2, tolerance[1] ** -2])


def test_ends_that_saw_nothing_keep_the_pose_of_the_user():
    made = ManualClosure("a", 0.0, "b", 0.0, OFF, (0.5, 0.1))
    assert measured(made, [], [])[0] == pytest.approx(OFF)
