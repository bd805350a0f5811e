"""Why maps of a run are apart: the binding reason with its numbers."""

from dataclasses import replace

import numpy as np

from fcslam.cloud.settings import FleetConfig
from fcslam.config import dump
from fcslam.mission.mission import MissionConfig
from fcslam.records import Channel, ClosureStatus, Reason, ReasonCode
from fcslam.runs import ClosureRow, RobotTrajectory, Run, separations

FEW = Reason(ReasonCode.FEW_PLACES, 2, 3, "fleet.consistency.minimum_evidence")


def run_of(maps, *closures):
    trajectories = {robot: RobotTrajectory(robot, k, np.zeros(1), np.zeros((1, 3))) for robot, k in maps.items()}
    rows = [ClosureRow(i, 0.0, j, 0.0, Channel.LIDAR, 0.5, np.zeros(3), *why) for i, j, *why in closures]
    return Run(trajectories, tuple(rows))


def test_verified_closures_name_what_they_lack():
    rejected = [("a", "b", ClosureStatus.REJECTED, FEW)] * 146
    failed = ("a", "b", ClosureStatus.CANDIDATE, Reason(ReasonCode.FEW_POINTS, 100, 250, "x"))
    (found,) = separations(run_of({"a": 0, "b": 1}, failed, *rejected))
    assert (found.candidates, found.verified, found.reason) == (1, 146, FEW)
    assert str(found) == (
        "map 0 (a) and map 1 (b): 146 verified closures, but they agree from 2 separate places, 3 needed; "
        "drive b through map 0 around (0.0, 0.0) again, and beyond"
    )


def test_the_closest_candidate_speaks_where_nothing_was_verified():
    reasons = [
        Reason(ReasonCode.NOT_ENOUGH_EXPLAINED, 0.79, 0.8, "explained"),
        Reason(ReasonCode.FEW_POINTS, 120, 250, "count"),
        Reason(ReasonCode.FEW_POINTS, 238, 250, "count"),
    ]
    (found,) = separations(run_of({"a": 0, "b": 1}, *(("b", "a", ClosureStatus.CANDIDATE, why) for why in reasons)))
    assert found.reason == reasons[2]
    assert "3 candidates, none verified: 238 points lie on a surface, 250 needed; drive b through map 0" in str(found)


def test_maps_that_were_not_to_be_joined_need_no_reason():
    run = run_of({"a": 0, "b": 1})
    for joins, count in ((True, 1), (False, 0)):
        config = dump(MissionConfig(fleet=FleetConfig(join_maps=joins)))
        assert len(separations(replace(run, config_yaml=config))) == count


def test_maps_of_several_robots_take_the_strongest_pair():
    other = Reason(ReasonCode.NO_LEAD, 1.2, 2)
    run = run_of(
        {"a": 0, "b": 0, "c": 1},
        ("a", "c", ClosureStatus.REJECTED, other),
        *[("c", "b", ClosureStatus.REJECTED, FEW)] * 2,
        ("a", "b", ClosureStatus.ACCEPTED, Reason(ReasonCode.FITS_JOINT_GRAPH)),
    )
    (found,) = separations(run)
    assert (found.maps, found.robots, found.verified, found.reason) == ((0, 1), (("a", "b"), ("c",)), 3, FEW)


def test_every_pair_of_maps_is_named_and_one_map_has_none():
    assert [s.maps for s in separations(run_of({"a": 0, "b": 1, "c": 2}))] == [(0, 1), (0, 2), (1, 2)]
    assert separations(run_of({"a": 0, "b": 0})) == []
    (nothing,) = separations(run_of({"a": 0, "b": 1}))
    assert str(nothing) == (
        "map 0 (a) and map 1 (b): no two of their places look alike; drive b through a part of map 0"
    )


def test_every_code_has_a_text():
    for code in ReasonCode:
        assert str(Reason(code, 1.0, 2.0, "setting"))
