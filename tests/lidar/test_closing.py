"""Closures of one robot that wait for support: which are accepted does not depend on their order."""

from itertools import permutations

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.closing import MINIMUM_SPREAD_M, MINIMUM_SUPPORT, LocalClosure, supported
from fcslam.lidar.submap import Agreement
from fcslam.lidar.verification import Verification
from fcslam.records import Reason, ReasonCode

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
