"""Which keyframes accepted closures connect, and how they lie to one another."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[train]")

from fcslam.geometry import se2
from fcslam.lab.evaluation.federated.mapped_drives import REACH_M, MappedDrive, ties
from fcslam.records import Channel, ClosureStatus, Reason, ReasonCode, frozen
from fcslam.runs import ClosureRow, Run

T_MAP_OWN = {"a": np.array([0.0, 0.0, 0.0]), "b": np.array([3.0, 1.0, 0.5])}


def drive(robot, first_stamp, map_index=0):
    """There and back along a line, a keyframe a metre."""
    x = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    own = np.column_stack((x, np.zeros(12), np.repeat([0.0, np.pi], 6)))
    stamps = first_stamp + np.arange(12.0)
    return MappedDrive(robot, (), stamps, own, se2.compose(T_MAP_OWN[robot], own), map_index)


def closure(i, stamp_i, j, stamp_j, status=ClosureStatus.ACCEPTED):
    return ClosureRow(
        i, stamp_i, j, stamp_j, Channel.CAMERA, 0.5, frozen(np.zeros(3)), status, Reason(ReasonCode.VERIFIED)
    )


def run(*closures):
    return Run({}, tuple(closures))


A, B = drive("a", 100.0), drive("b", 100.001)
DRIVES = {"a": A, "b": B}


def test_an_accepted_closure_connects_the_keyframes_around_its_ends():
    found = list(ties(DRIVES, run(closure("a", 100.0, "b", 106.001))))
    assert {(tie.robot_i, tie.robot_j) for tie in found} == {("a", "b")}
    near_a = {k for k in range(12) if A.T_own_base[k, 0] <= REACH_M and k < 6}
    near_b = {k for k in range(12) if abs(B.T_own_base[k, 0] - 5.0) <= REACH_M}
    assert {tie.i for tie in found} == near_a
    assert {tie.j for tie in found} == near_b
    for tie in found:
        assert tie.T_i_j == pytest.approx(se2.between(A.T_map_base[tie.i], B.T_map_base[tie.j]))


def test_keyframes_that_several_closures_connect_count_once():
    twice = run(closure("b", 101.001, "a", 110.0), closure("a", 110.0, "b", 101.001), closure("a", 109.0, "b", 102.001))
    keys = [(tie.i, tie.j) for tie in ties(DRIVES, twice)]
    assert len(keys) == len(set(keys)) > 0


@pytest.mark.parametrize("status", [ClosureStatus.CANDIDATE, ClosureStatus.VERIFIED, ClosureStatus.REVOKED])
def test_only_accepted_closures_count(status):
    assert not list(ties(DRIVES, run(closure("a", 100.0, "b", 106.001, status))))


def test_closures_of_one_robot_and_other_maps_give_nothing():
    between = run(closure("a", 100.0, "b", 106.001))
    assert not list(ties(DRIVES, run(closure("a", 100.0, "a", 106.0))))
    assert not list(ties({"a": A, "b": drive("b", 100.001, map_index=1)}, between))
    assert not list(ties({"a": A}, between))
