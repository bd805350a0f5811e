"""Whether to use a map: what speaks against one, and how much."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.records import Channel, ClosureStatus, Reason, ReasonCode
from fcslam.runs import ClosureRow, Join, RobotTrajectory, Run, Use

STAMPS = np.arange(21.0)
JOIN = Join("a", "b", 12, 5, 140.0, 0.3, 1.1, 0.1)


def drive(robot, map_index=0, length_m=20.0):
    poses = np.column_stack((length_m * STAMPS / 20.0, np.zeros((21, 2))))
    return RobotTrajectory(robot, map_index, STAMPS, poses)


def certificate(bound_m=0.03, **more):
    cells = [{"x": 0.5, "y": 0.5, "bound_95": 0.03, "good": True}]
    cells += [{"x": 4.5, "y": 0.5, "bound_95": bound_m, "good": bound_m <= 0.05}]
    share = sum(cell["good"] for cell in cells) / 2
    said = {"bar": 0.05, "within": 10.0, "cell": 1.0, "error_95": bound_m, "good_share": share, "drives": [],
            "open_ends": [], "cells": cells}  # fmt: skip
    return said | more


def run_of(*drives, joins=(), closures=(), said=None):
    maps = {str(one.map_index) for one in drives}
    content = json.dumps(dict.fromkeys(maps, said or certificate()))
    return Run({one.robot: one for one in drives}, tuple(closures), tuple(joins), quality=content)


PAIR = run_of(drive("a"), drive("b"), joins=[JOIN])


def test_a_good_map_has_no_concern_and_says_what_that_rests_on():
    (verdict,) = PAIR.verdict
    assert (verdict.use, str(verdict), verdict.concerns) == (Use.USE, "use this map", ())
    assert verdict.details == (
        "joined: a and b: 12 closures from 5 places; 140 m of wall seen by both, 0.3 m (0.2 %) contradict; "
        "elsewhere the maps fit 0.10 times as well",
        "accurate to 3 cm within 10 m",
        "2 m2 are known",
    )


@pytest.mark.parametrize(
    ("wrong", "use", "says"),
    [
        ({"contradicting_m": 4.0}, Use.WAIT, "the walls of a and b do not fit: a share of 0.0286"),
        ({"likeness": 0.3}, Use.WAIT, "the walls of a and b do not fit: walls lie farther apart"),
        ({"elsewhere": 0.9}, Use.WAIT, "the walls of a and b do not fit: the maps fit only 1.11 times"),
        ({"elsewhere": 0.6}, Use.RESERVE, "the walls of a and b fit elsewhere 0.60 times as well"),
    ],
)
def test_walls_that_do_not_fit_speak_against_a_join_however_it_came_about(wrong, use, says):
    (verdict,) = replace(PAIR, joins=(replace(JOIN, **wrong),)).verdict
    assert verdict.use is use
    assert says in str(verdict)


def test_a_join_by_hand_needs_walls_that_confirm_it_and_names_its_place():
    reason = Reason(ReasonCode.PINNED)
    pin = ClosureRow("a", 7.0, "b", 3.0, Channel.LIDAR, 0.5, np.zeros(3), ClosureStatus.ACCEPTED, reason)
    blind = replace(JOIN, seen_m=np.nan, contradicting_m=np.nan, likeness=np.nan, elsewhere=np.nan)
    (verdict,) = replace(PAIR, closures=(pin,), joins=(blind,)).verdict
    assert str(verdict) == (
        "do not use this map yet: a and b are joined by hand, and no wall confirms it; take back what joined them "
        "by hand: fcslam edit undo"
    )
    assert verdict.concerns[0].where == ((7.0, 0.0),)
    assert replace(PAIR, closures=(pin,)).verdict[0].use is Use.USE


def test_accuracy_names_the_place_and_the_drive_that_helps():
    (bad,) = run_of(drive("a"), said=certificate(0.09)).verdict
    assert bad.use is Use.RESERVE
    assert "1 of 2 m2 around (4.5, 0.5) may be off by more than 5 cm; another drive does not help" in str(bad)
    again = certificate(0.09, drives=[{"from": [0.5, 0.0], "to": [4.0, 0.0], "gain_m2": 12}])
    (better,) = run_of(drive("a"), said=again).verdict
    assert str(better).endswith("drive from (0.5, 0.0) to (4.0, 0.0) again, which makes about 12 m2 good")
    assert better.concerns[0].where == ((0.5, 0.0), (4.0, 0.0))
    assert run_of(drive("a"), said=certificate(0.3)).verdict[0].use is Use.WAIT
    assert replace(PAIR, quality=b"").verdict[0].concerns[0].why == "its accuracy is not known"


def test_a_length_that_nothing_shows_has_no_number():
    (unknown,) = run_of(drive("a"), said=certificate(10.0)).verdict
    assert unknown.use is Use.WAIT
    assert "its length around (4.5, 0.5) is not known, as neither wheels nor scans show it" in str(unknown)
    assert not any("accurate" in line for line in unknown.details)


def test_what_a_recording_says_against_a_map_counts():
    (verdict,) = run_of(drive("a"), said=certificate(doubts=["anna: a ramp"])).verdict
    assert (verdict.use, str(verdict)) == (Use.WAIT, "do not use this map yet: anna: a ramp")


def test_a_robot_that_is_apart_is_a_reserve_of_both_maps():
    first, second = run_of(drive("a"), drive("b", 1)).verdict
    assert str(first) == (
        "use this map, but b has another map (no two of their places look alike); drive b through a part of map 0"
    )
    assert "a has another map" in str(second)
    assert replace(PAIR, config_yaml="fleet:\n  join_maps: false\n").verdict[0].use is Use.USE


def test_a_short_drive_and_a_jump_are_no_map():
    assert "it shows 3.0 m of path" in str(run_of(drive("a", length_m=3.0)).verdict[0])
    jumped = drive("a")
    jumped.T_map_base[9:, 1] += 500.0
    (verdict,) = run_of(jumped).verdict
    assert verdict.use is Use.WAIT
    assert verdict.concerns[0].where == ((9.0, 500.0),)


def test_where_the_map_is_open_is_a_fact():
    said = certificate(open_ends=[{"x": 3.2, "y": 7.1, "gain_m2": 20.0}])
    assert (
        run_of(drive("a"), said=said).verdict[0].details[-1]
        == "2 m2 are known; the map is open at 1 place, most at (3.2, 7.1)"
    )


@pytest.mark.parametrize("content", [b"[]x", b"7", b'{"0": 7}', b'{"0": {"good_share": 1}}'])
def test_a_broken_certificate_is_one_line(content):
    with pytest.raises(InputError, match=r"quality\.json is broken"):
        _ = replace(PAIR, quality=content).verdict
