"""Robots that share a tag and nothing else join, unless the tag is there twice; a moved tag bends no map."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.settings import FleetConfig
from fcslam.cloud.tags import MOST_CLOSURES
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.records import (
    Channel,
    ClosureStatus,
    Constraint,
    ConstraintKind,
    Keyscan,
    KeyscanId,
    ReasonCode,
    Tag,
    TagFamily,
    TagSighting,
    frozen,
)
from fcslam.wire.limits import MAXIMUM_TAGS
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import measure
from fcslam.wire.quantisation import dequantise, quantise
from tests.planned_building import LASER, OTHER_WALLS, WALLS, ranges_at, sides
from tests.small_fleet import feed, fingerprint, in_order, map_of, restored

pytestmark = pytest.mark.slow

TAG = Tag(TagFamily.APRILTAG_36H11, 7)
AT = np.array((9.9, 2.0, np.pi))
"""On a wall, where it faces west."""
SIGMA = np.array((0.02, 0.02, 0.02))
STEP_M, NEAR_M = 0.25, 2.5


def line(start, end, heading):
    count = int(np.hypot(*np.subtract(end, start)) / STEP_M)
    return np.column_stack((np.linspace(start, end, count), np.full(count, heading)))


SOUTH, NORTH = line((7.0, 0.8), (9.0, 2.0), 0.3), line((6.0, 4.8), (8.6, 2.9), -0.6)
"""Ways of two robots to the tag."""


def drive(robot, way, tags=(), walls=WALLS, start_s=0.0, seed=0, within_m=np.inf):
    """What a robot sends that describes no places: keyscans, motions, and the tags (tag, pose, last keyscans)."""
    rng, seen = np.random.default_rng(seed), sides(walls)
    bodies = [(start_s, Hello(robot, 0, (LASER,), {}))]
    steps = se2.compose(se2.relative(way), rng.normal(0.0, (0.004, 0.004, 0.001), (len(way) - 1, 3)))
    for k, pose in enumerate(way):
        stamp = start_s + k
        ranges = dequantise(quantise((ranges_at(pose, seen) + rng.normal(0.0, 0.01, 360)).astype(np.float32)))
        bodies.append((stamp, Keyscan(KeyscanId(robot, k), stamp, ranges)))
        if k:
            motion = Constraint(
                robot, k - 1, k, ConstraintKind.ODOMETRY, frozen(steps[k - 1]), frozen(np.diag((6e4, 6e4, 1e6)))
            )
            bodies.append((stamp, motion))
        for tag, at, last in tags:
            if k >= len(way) - last and np.hypot(*(pose - at)[:2]) < within_m:
                off = rng.normal(0.0, 0.3 * SIGMA)
                T_base_tag = frozen(se2.compose(se2.between(pose, np.array(at)), off))
                bodies.append((stamp, TagSighting(KeyscanId(robot, k), tag, T_base_tag, frozen(np.diag(SIGMA**-2.0)))))
    return [measure(Packet(robot, 0, n, time, body)).packet for n, (time, body) in enumerate(bodies)]


def fleet_of(packets):
    fleet = Fleet(FleetConfig(), 0)
    for packet in in_order(packets):
        fleet.apply(packet)
    return fleet


def concluded(packets):
    return fleet_of(packets).conclude()


def gap_m(result, ways, at=AT):
    """Distance of the tag's true place by one robot's map, and by the other's."""
    there = [
        se2.compose(robot.T_map_base[-1], se2.between(way[-1], at))[:2]
        for robot, way in zip(result.robots, ways, strict=True)
    ]
    return np.hypot(*(there[0] - there[1]))


def two(last=5, at_south=AT, at_north=AT, walls=WALLS):
    return [
        *drive("anna", SOUTH, [(TAG, at_south, last)]),
        *drive("berta", NORTH, [(TAG, at_north, last)], walls, start_s=0.5, seed=1),
    ]


def test_two_robots_that_share_one_tag_join_there():
    result = concluded(two())
    assert map_of(result) == {"anna": 0, "berta": 0}
    assert gap_m(result, (SOUTH, NORTH)) < 0.03
    assert {closure.channel for closure in result.closures} == {Channel.TAG}
    assert {closure.status for closure in result.closures} == {ClosureStatus.ACCEPTED}
    assert len(result.sightings) == 10
    ends = [end for closure in result.closures for end in (closure.i, closure.j)]
    assert len(ends) == len(set(ends)) == 10, "each sighting is in one closure with another session"


def test_without_the_tag_or_with_few_sightings_they_stay_apart():
    for last in (0, 2):
        assert len(set(map_of(concluded(two(last))).values())) == 2


def test_a_tag_that_is_there_twice_joins_no_maps_that_contradict_each_other():
    result = concluded(two(at_south=AT, at_north=np.array((2.0, 8.0, -1.3)), walls=OTHER_WALLS))
    assert len(set(map_of(result).values())) == 2
    (reason,) = {closure.reason.code for closure in result.closures}
    assert reason is ReasonCode.MAPS_CONTRADICT


@pytest.mark.parametrize("length_m", [4.0, 7.5])
def test_a_tag_is_one_place_from_wherever_it_is_seen(length_m):
    """So a long way to a tag that is there twice is no more evidence than a short one."""
    west = line((9.0 - length_m, 2.0), (9.0, 2.0), 0.0)
    far = [
        *drive("anna", west, [(TAG, AT, len(west))]),
        *drive("berta", west, [(TAG, AT, len(west))], OTHER_WALLS, start_s=0.5, seed=1),
    ]
    assert len(set(map_of(concluded(far)).values())) == 2


def test_many_sessions_of_one_robot_hide_a_tag_from_nobody():
    anna, berta = (drive(name, way, [(TAG, AT, 5)]) for name, way in (("anna", SOUTH), ("berta", NORTH)))
    zed = [
        replace(packet, epoch=n, time=100.0 * (n + 1) + packet.time)
        for n in range(10)
        for packet in drive("zed", SOUTH, [(TAG, AT, 1)])
    ]
    late = [replace(packet, time=5000.0 + packet.time) for packet in berta]
    result = concluded([*anna, *zed, *late])
    assert sum({c.i.robot, c.j.robot} == {"anna", "berta"} for c in result.closures) == 5


def test_closures_by_tags_are_limited():
    often = [(Tag(TAG.family, number), AT, len(LOOP)) for number in range(20)]
    result = concluded([*drive("anna", LOOP, often), *drive("berta", LOOP, often)])
    assert sum(closure.i.robot != closure.j.robot for closure in result.closures) == MOST_CLOSURES


def test_the_result_does_not_depend_on_the_order_of_arrival():
    packets = in_order(two())
    shuffled = [packets[k] for k in np.random.default_rng(1).permutation(len(packets))]
    one, other = (fingerprint(feed(Cloud(FleetConfig(), 0), order).finalize()) for order in (packets, shuffled))
    assert one == other


def test_a_restored_fleet_goes_on_as_if_it_had_never_stopped(tmp_path):
    packets = in_order(two())
    again = restored(fleet_of(packets[:-8]), packets, tmp_path / "state")
    for packet in packets[-8:]:
        again.apply(packet)
    one, other = concluded(packets), again.conclude()
    assert fingerprint(one) == fingerprint(other)
    assert [(s.id, s.tag) for s in one.sightings] == [(s.id, s.tag) for s in other.sightings]


LOOP = np.vstack((line((1.0, 1.0), (4.0, 1.0), 0.0), line((4.0, 1.0), (4.0, 4.5), 1.57),
                  line((4.0, 4.5), (1.0, 4.5), 3.14), line((1.0, 4.5), (1.0, 1.0), -1.57),
                  line((1.0, 1.0), (4.0, 1.0), 0.0)))[::2]  # fmt: skip
SEEN = [
    ((4.8, 2.0, np.pi), 1),
    ((4.8, 3.5, np.pi), 2),
    ((2.0, 5.9, -1.57), 3),
    ((0.1, 3.0, 0.0), 4),
    ((0.1, 1.5, 0.0), 5),
]


def loop(name, moved_m, start_s, seed):
    tags = [
        (Tag(TAG.family, number), (at[0], at[1] + moved_m * (number == 1), at[2]), len(LOOP)) for at, number in SEEN
    ]
    return drive(name, LOOP, tags, start_s=start_s, seed=seed, within_m=NEAR_M)


def test_a_moved_tag_is_outvoted_and_bends_nothing():
    before, after = (
        concluded([*loop("today", 0.0, 0.0, 0), *loop("tomorrow", moved_m, 86400.0, 1)]) for moved_m in (0.0, 0.5)
    )
    assert map_of(after) == {"today": 0, "tomorrow": 0}
    between = [c for c in after.closures if c.i.robot != c.j.robot]
    assert {c.status is ClosureStatus.ACCEPTED for c in between if c.tag.number == 1} == {False}
    assert {c.status is ClosureStatus.ACCEPTED for c in between if c.tag.number != 1} == {True}
    bent = [
        np.hypot(*(a.T_map_base - b.T_map_base)[:, :2].T).max()
        for a, b in zip(before.robots, after.robots, strict=True)
    ]
    assert max(bent) < 0.02


def test_a_robot_that_comes_back_to_a_tag_closes_its_loop():
    result = concluded(loop("anna", 0.0, 0.0, 0))
    own = [closure for closure in result.closures if closure.channel is Channel.TAG]
    assert own
    assert {closure.status for closure in own} == {ClosureStatus.ACCEPTED}
    assert min(closure.j.number - closure.i.number for closure in own) * 2 * STEP_M > 9.0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"id": KeyscanId("anna", 99)}, "names keyscan 99, which it never sent"),
        ({"T_base_tag": frozen((51.0, 0.0, 0.0))}, "tag apriltag_36h11 31 is 51 m away, at most 50 m"),
        ({}, "keyscan 8 saw tag apriltag_36h11 31 before"),
        ({"tag": TAG}, "keyscan 8 saw tag apriltag_36h11 7 before"),
        ({"tag": TAG._replace(number=99)}, "keyscan 8 saw more than 32 tags"),
    ],
)
def test_a_sighting_that_does_not_fit_is_refused_and_changes_nothing(change, reason):
    packets = drive("anna", SOUTH, [(Tag(TAG.family, number), AT, 1) for number in range(MAXIMUM_TAGS)])
    fleet, last = fleet_of(packets), packets[-1]
    before = repr(fleet.state()["tags"]), fingerprint(fleet.conclude())
    with pytest.raises(PacketError, match=reason):
        fleet.apply(replace(last, sequence=999, body=replace(last.body, **change)))
    assert (repr(fleet.state()["tags"]), fingerprint(fleet.conclude())) == before
