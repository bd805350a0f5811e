"""Closures of one robot that wait for support: which are accepted does not depend on their order."""

from itertools import permutations

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.backend import LidarBackend
from fcslam.lidar.closing import MINIMUM_SPREAD_M, MINIMUM_SUPPORT, LocalClosure, consistency, supported
from fcslam.lidar.frontend import LidarConfig, MappedKeyscan
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import Agreement
from fcslam.lidar.verification import Verification
from fcslam.records import Constraint, ConstraintKind, Keyscan, KeyscanId, LaserModel, Reason, ReasonCode
from fcslam.robot.backend import OwnPlaces
from tests.lidar.worlds import box, path, ranges

VERIFIED = Reason(ReasonCode.VERIFIED)

STEP_M = 5.0
ANCHORS = np.array([(STEP_M * k, 0.0, 0.0) for k in range(20)])
"""A straight drive; by the estimate, submaps 10 and later lie beyond those of the first half."""
TRAVEL = ANCHORS[:, 0]
RETURN = np.array((-50.0, 0.3, 0.02))
"""The robot was in fact back at submap 0 with submap 10: the drift of the estimate, in the base of submap 0."""


def closure(earlier, later, T_a_b, is_informative=True):
    worse = Agreement(0.9, 0.0, 100, 0.5, np.eye(3))
    check = Verification(T_a_b, np.eye(3), worse, True, True, True, is_informative, VERIFIED, VERIFIED)
    innovation = se2.between(se2.between(ANCHORS[earlier], ANCHORS[later]), T_a_b)
    return LocalClosure(earlier, later, check, innovation, 1.0)


def returned(earlier, later, is_informative=True):
    """A closure of the drive that is true."""
    T_map_later = se2.compose(RETURN, ANCHORS[later])
    return closure(earlier, later, se2.between(ANCHORS[earlier], T_map_later), is_informative)


TRUE = [returned(k, 10 + k) for k in range(4)]
FALSE = closure(2, 14, np.array((3.0, 2.0, 1.5)))


@pytest.mark.parametrize("order", list(permutations(range(5))))
def test_the_supported_closures_do_not_depend_on_their_order(order):
    pending = [[*TRUE, FALSE][k] for k in order]
    accepted = supported(pending, TRAVEL, ANCHORS)
    assert {id(c) for c in accepted} == {id(c) for c in TRUE}


def test_support_spread_and_information_are_needed():
    assert supported([], TRAVEL, ANCHORS) == []
    assert MINIMUM_SUPPORT > 1.0
    assert supported(TRUE[:1], TRAVEL, ANCHORS) == []
    at_one_place = [returned(k, 10) for k in range(4)]
    assert MINIMUM_SPREAD_M > 0.0
    assert supported(at_one_place, TRAVEL, ANCHORS) == []
    along_a_corridor = [returned(k, 10 + k, is_informative=False) for k in range(4)]
    assert supported(along_a_corridor, TRAVEL, ANCHORS) == []


def test_of_two_clusters_the_one_with_more_support_counts():
    other = [closure(k, 15 + k, np.array((1.0, -4.0, 0.5))) for k in range(3)]
    assert {c.later for c in supported([*TRUE, *other], TRAVEL, ANCHORS)} == {10, 11, 12, 13}


def test_closures_that_agree_with_one_but_not_with_each_other_do_not_support_it():
    """Of three submaps in a row, the first and the last lie 0.35 m to either side of where the second says."""
    anchors = np.array([(2.0 * k, 0.0, 0.0) for k in range(20)])
    aside_m = {0: -0.35, 1: 0.0, 2: 0.35}
    star = [closure(k, 10 + k, np.array((0.0, y, 0.0))) for k, y in aside_m.items()]
    consistent = consistency(star, anchors[:, 0], anchors)
    assert consistent[1].all()
    assert not consistent[0, 2]
    assert supported(star, anchors[:, 0], anchors) == []


def test_two_closures_are_consistent_with_each_other_or_neither_is():
    """A loop that ends 1 m off with a turn of 0.2 rad ends elsewhere if it is driven the other way round."""
    rng = np.random.default_rng(1)
    scattered = [closure(k, 10 + k, se2.compose(rng.normal(0.0, (0.5, 0.5, 0.1)), RETURN)) for k in range(10)]
    consistent = consistency(scattered, TRAVEL, ANCHORS)
    assert not consistent.all()
    assert (consistent == consistent.T).all()
    supported(scattered, TRAVEL, ANCHORS)


CORRIDOR_M = 50.0
SHORT_LASER = LaserModel(360, -np.pi, np.deg2rad(1.0), 12.0)


def rooms_at_both_ends():
    """A bare corridor between two furnished rooms."""
    walls = [(0.0, -1.2), (CORRIDOR_M, -1.2)], [(0.0, 1.2), (CORRIDOR_M, 1.2)]
    near = [(0.0, -1.2), (0.0, -4.0), (-8.0, -4.0), (-8.0, 4.0), (0.0, 4.0), (0.0, 1.2)]
    end = CORRIDOR_M
    far = [(end, -1.2), (end, -4.0), (end + 7.0, -4.0), (end + 7.0, 3.0), (end, 3.0), (end, 1.2)]
    things = box(-5.0, -2.0, -4.0, -1.0), box(-3.0, 2.0, -2.3, 3.0), box(end + 3.0, -3.0, end + 4.0, -2.0)
    return np.vstack((*(path(*wall) for wall in (*walls, near, far)), *things))


def test_closures_along_a_bare_corridor_do_not_end_the_search_for_the_loop_at_its_end():
    """Wheels measure 3 % too much on the way back; each closure on the way repeats its guess along the corridor."""
    rng = np.random.default_rng(0)
    there = np.arange(-5.0, CORRIDOR_M + 4.0, 0.5)
    true = np.array([(x, 0.1 * np.sin(x / 3.0), 0.0) for x in there] + [(x, 0.0, np.pi) for x in there[::-1]])
    seen = ranges(true, rooms_at_both_ends(), SHORT_LASER, 0.015, rng)
    backend = LidarBackend("r", LidarConfig(), OwnPlaces())
    pose, travel_m = true[0], 0.0
    for k in range(len(true)):
        odometry = None
        if k:
            moved = se2.between(true[k - 1], true[k])
            in_corridor, is_back = 0.0 < true[k, 0] < CORRIDOR_M, true[k, 2] > 3.0
            slip = 1.03 if in_corridor and is_back else 1.0
            moved = moved * (slip, 1.0, 1.0) + rng.normal(0.0, 1.0, 3) * (0.003, 0.002, 0.0005)
            pose, travel_m = se2.compose(pose, moved), travel_m + abs(moved[0]) + 0.1 * abs(moved[2])
            sigmas = np.array((0.06 if in_corridor else 0.008, 0.008, 0.004))
            odometry = Constraint("r", k - 1, k, ConstraintKind.ODOMETRY, moved, np.diag(sigmas**-2))
        record = Keyscan(KeyscanId("r", k), float(k), seen[k], 0, None, None)
        backend.add(MappedKeyscan(record, odometry, point_scan(seen[k], SHORT_LASER), pose, pose, travel_m))
    backend.finish()
    assert np.hypot(*(pose - true[-1])[:2]) > 1.0
    assert np.hypot(*(backend.keyscan_poses()[-1] - true[-1])[:2]) < 0.1
