"""Edits: what users change by hand takes effect at once, exactly in the result, and can be undone."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.edits import in_force
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.mission.edits import check_undo, edit_json, kind_of, read_edit
from fcslam.records import (
    Cut,
    Edit,
    FloorLabel,
    ManualClosure,
    MapRegion,
    Pin,
    Place,
    Placement,
    RegionUse,
    Removal,
    Undo,
    Veto,
)
from fcslam.wire.messages import Hello
from tests.cloud.test_fleet import POSES, A, B, C, two_robots
from tests.cloud.test_fleet import TRUE as PAIRS
from tests.scripted import ALIAS, closures, rectangle, stream
from tests.small_fleet import feed, fingerprint, in_order, map_of, restored

pytestmark = pytest.mark.slow

CONTENTS = [
    Veto("a", "b"), Veto("a", "a", (1.5, 2.0)), Removal("b"), Removal("a", 3), Cut("a", 1.0, 2.0),
    Pin("a", "b", (1.0, 2.0)),
    ManualClosure("a", 1.0, "b", 2.0, (0.0, 1.0, 2.0), (0.1, 0.1)), Placement("a", 1.0, (0.0, 1.0, 2.0)),
    MapRegion(RegionUse.KEEP_OUT, "stairs", "a", 1.0, ((0.0, 0.0), (1.0, 0.0), (1.0, 1.5))), Undo(7),
    FloorLabel("a+1", "-1"),
]  # fmt: skip
SQUARE = '"polygon": [[0, 0], [1, 0], [1, 1]]'
T = '"stamp_i": 1, "T_i_j": [0, 0, 0]'


def log(*contents):
    return [Edit(number, "boss", 0.0, content) for number, content in enumerate(contents, start=1)]


@pytest.mark.parametrize("content", CONTENTS, ids=str)
def test_an_edit_survives_as_text(content):
    assert read_edit(kind_of(content), edit_json(content)) == content


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("rumour", "{}"), ("veto", "{"), ("veto", '{"robot_i": "a"}'), ("removal", '{"robot": "a", "epoch": "1"}'),
        ("veto", '{"robot_i": "a", "robot_j": "b", "stamps": [1, NaN]}'), ("undo", '{"number": null}'), ("undo", "[]"),
        ("removal", '{"robot": "a", "epoch": -1}'), ("removal", f'{{"robot": "a", "epoch": {10**400}}}'),
        ("veto", '{"robot_i": "a", "robot_j": "b", "more": 1}'),
        ("cut", '{"session": "a", "first_s": 2, "last_s": 2}'), ("pin", '{"robot_i": "a", "robot_j": "b"}'),
        ("cut", '{"session": "a b", "first_s": 1, "last_s": 2}'),
        ("closure", f'{{"robot_i": "a", "robot_j": "b", "stamp_j": 2, {T}, "tolerance": [0, 1]}}'),
        ("closure", f'{{"robot_i": "a", "robot_j": "a", "stamp_j": 1, {T}, "tolerance": [1, 1]}}'),
        ("closure", f'{{"robot_i": "a", "robot_j": "b", "stamp_j": 2, {T}, "tolerance": [1e300, 1]}}'),
        ("placement", '{"session": "a", "stamp": 1, "pose": [1e9, 0, 0]}'),
        ("region", '{"use": "erase", "name": "", "session": "a", "stamp": 1, "polygon": [[0, 0], [1, 0]]}'),
        ("floor", '{"session": "a", "floor": ""}'), ("floor", '{"session": "a", "floor": "seventeen-letters"}'),
        ("region", f'{{"use": "burn", "name": "", "session": "a", "stamp": 1, {SQUARE}}}'),
        ("region", f'{{"use": "area", "name": "{101 * "x"}", "session": "a", "stamp": 1, {SQUARE}}}'),
    ],
)  # fmt: skip
def test_what_is_no_edit_is_refused(kind, content):
    with pytest.raises(InputError):
        read_edit(kind, content)


def test_in_force_is_what_nothing_undid():
    edits = log(Veto("a", "b"), Removal("b"), Undo(1), Removal("b"), Undo(2))
    assert in_force(edits) == (Removal("b"),)
    check_undo(edits, 4)
    for number in (0, 1, 2, 3, 6):
        with pytest.raises(InputError):
            check_undo(edits, number)


def with_liar():
    """The liar b joins a and c, which have nothing to do with each other."""
    return in_order([*stream(*A, start_s=0.0), *stream(*C, start_s=0.5), *stream(*B, start_s=1000.0)])


LIES = closures(A, B, PAIRS), closures(C, B, PAIRS, shift=ALIAS)


def test_a_removal_parts_at_once_what_only_the_robot_joined(scripted):
    cloud = feed(scripted(*LIES), with_liar())
    assert map_of(cloud.fleet.estimate()) == {"a": 0, "c": 0, "b": 0}
    cloud.fleet.edit([Removal("b")])
    seen = cloud.fleet.estimate()
    assert map_of(seen) == {"a": 0, "c": 1}
    assert seen.closures == ()
    assert [correction.robot for correction in cloud.fleet.corrections()] == ["a", "c"]
    assert len(seen.graph) == 2 * len(POSES)
    assert len(seen.graph.edges) == 2 * (len(POSES) - 1)


@pytest.mark.parametrize("when", ["before", "midway", "after"])
def test_the_result_is_what_it_would_have_been_without_the_robot(scripted, when):
    honest = feed(scripted(*LIES), [packet for packet in with_liar() if packet.robot != "b"])
    expected = fingerprint(honest.finalize())
    cut = {"before": 0, "midway": -100, "after": None}[when]
    cloud = feed(scripted(*LIES), with_liar()[:cut])
    cloud.fleet.edit([Removal("b")])
    feed(cloud, with_liar()[len(with_liar()[:cut]) :])
    assert fingerprint(cloud.finalize()) == expected
    assert set(map_of(cloud.fleet.estimate())) == {"a", "c"}


def test_only_the_named_session_is_removed(scripted):
    starts = [replace(p, epoch=1, body=replace(p.body, epoch=1)) if p.sequence == 0 else replace(p, epoch=1)
              for p in stream("a", POSES, start_s=500.0)]  # fmt: skip
    cloud = feed(scripted(), [*stream("a", POSES, start_s=0.0), *starts])
    assert set(map_of(cloud.finalize())) == {"a", "a+1"}
    cloud.fleet.edit([Removal("a", 1)])
    assert set(map_of(cloud.fleet.estimate())) == set(map_of(cloud.finalize())) == {"a"}


WAY = rectangle(29)
BEGUN = [*stream("a", WAY, start_s=0.0), *stream("b", WAY, start_s=1000.0)]
SEEN = closures(("a", WAY), ("b", WAY), PAIRS[:4])


def a_first_closure(result):
    """The first accepted closure between two robots, as an edit would name it."""
    closure = next(c for c in result.closures if c.i.robot != c.j.robot and c.status == "accepted")
    stamps = {robot.robot: robot.stamps for robot in result.robots}
    at_i, at_j = (float(stamps[end.robot][end.number]) for end in (closure.i, closure.j))
    return closure, at_i, at_j


def edits_that_can_be_undone(result):
    closure, at_i, at_j = a_first_closure(result)
    i, j = closure.i.robot, closure.j.robot
    T_i_j = tuple((closure.T_i_j + np.array((0.4, -0.3, 0.05))).tolist())
    return {
        "veto": Veto(i, j),
        "cut": Cut(i, at_i - 3.0, at_i + 3.0),
        "pin": Pin(i, j, (at_i, at_j)),
        "closure": ManualClosure(i, at_i, j, at_j, T_i_j, (0.001, 0.001)),
        "rough closure": ManualClosure(i, at_i, j, at_j, T_i_j, (0.5, 0.1)),
        "placement": Placement(i, at_i, (3.0, 4.0, 1.0)),
        "region": MapRegion(RegionUse.AREA, "Room 1", i, at_i, ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0))),
    }


def told(result):
    """As a fingerprint, with the regions."""
    regions = [(r.use, r.name, r.map_index, r.polygon.tobytes()) for r in result.regions]
    return fingerprint(result), regions


@pytest.mark.parametrize("kind", ["veto", "cut", "pin", "closure", "rough closure", "placement", "region"])
def test_an_edit_counts_whenever_it_is_made_and_its_undo_leaves_no_trace(scripted, kind):
    midway, late = feed(scripted(SEEN), BEGUN[:-20]), feed(scripted(SEEN), BEGUN)
    unedited = late.finalize()
    before, change = told(unedited), edits_that_can_be_undone(unedited)[kind]
    midway.fleet.edit([change])
    edited = told(feed(midway, BEGUN[-20:]).finalize())
    assert edited != before
    midway.fleet.edit([])
    assert told(midway.finalize()) == before
    late.fleet.edit([change])
    assert told(late.finalize()) == edited


def test_a_floor_by_hand_counts_as_one_that_the_robot_named(packets):
    two = [packet for packet in packets if packet.robot != "robot_3"]
    assert set(map_of(feed(Cloud(FleetConfig(), 0), two).finalize()).values()) == {0}
    cloud = Cloud(FleetConfig(), 0)
    cloud.fleet.edit([FloorLabel("robot_2", "2")])
    result = feed(cloud, two).finalize()
    assert {robot.robot: robot.floor for robot in result.robots if robot.map_index == 1} == {"robot_2": "2"}
    named = [
        replace(packet, body=replace(packet.body, floor="2"))
        if packet.robot == "robot_2" and isinstance(packet.body, Hello)
        else packet
        for packet in two
    ]
    assert told(result) == told(feed(Cloud(FleetConfig(), 0), named).finalize())
    with pytest.raises(ValueError, match="floor"):
        cloud.fleet.edit([])


def test_no_closure_by_hand_joins_floors(scripted):
    made = ManualClosure("a", 10.2, "b", 1020.0, (1.0, 2.0, 0.5), (0.1, 0.05))
    for label, maps in (("2", {"a": 0, "b": 1}), ("1", {"a": 0, "b": 0})):
        cloud = scripted()
        cloud.fleet.edit([FloorLabel("a", "1"), FloorLabel("b", "3"), FloorLabel("b", label), made])
        assert map_of(feed(cloud, TWO).finalize()) == maps


TWO = two_robots()


def test_a_pin_joins_maps_on_one_closure(scripted):
    script = closures(A, B, PAIRS[:1])
    assert map_of(feed(scripted(script), TWO).finalize()) == {"a": 0, "b": 1}
    for before in (True, False):
        cloud = scripted(script)
        changes = [Pin("b", "a", (1000.0, 0.0))]
        if before:
            cloud.fleet.edit(changes)
        feed(cloud, TWO)
        cloud.fleet.edit(changes)
        result = cloud.finalize()
        assert map_of(result) == {"a": 0, "b": 0}
        (closure,) = result.closures
        assert (closure.status, closure.reason.code) == ("accepted", "pinned")
        cloud.fleet.edit([*changes, Veto("a", "b")])
        assert map_of(cloud.finalize()) == {"a": 0, "b": 1}, "a veto outweighs a pin"


def test_a_closure_by_hand_joins_maps_where_nothing_was_recognised(scripted):
    cloud = feed(scripted(), TWO)
    cloud.fleet.edit([ManualClosure("a", 10.2, "b", 1020.0, (1.0, 2.0, 0.5), (0.1, 0.05))])
    assert map_of(cloud.fleet.estimate()) == {"a": 0, "b": 0}
    result = cloud.finalize()
    a, b = result.robots
    assert se2.between(a.T_map_base[10], b.T_map_base[20]) == pytest.approx((1.0, 2.0, 0.5), abs=1e-6)
    assert [c.reason.code for c in result.closures] == ["made_by_hand"]


@pytest.mark.parametrize("veto", [Veto("b", "a"), Veto("a", "b", (10.0, 1020.0))])
@pytest.mark.parametrize("before", [True, False], ids=["edits first", "packets first"])
def test_a_veto_outweighs_a_closure_by_hand_that_is_made_with_it(scripted, veto, before):
    cloud = scripted()
    changes = [ManualClosure("a", 10.2, "b", 1020.0, (1.0, 2.0, 0.5), (0.1, 0.05)), veto]
    if before:
        cloud.fleet.edit(changes)
    feed(cloud, TWO)
    if not before:
        cloud.fleet.edit(changes)
    result = cloud.finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert [(c.status, c.reason.code) for c in result.closures] == [("revoked", "vetoed")]


def test_a_closure_by_hand_outweighs_others(scripted):
    """Six closures say one thing, the user another."""
    cloud = feed(scripted(closures(A, B, PAIRS, shift=ALIAS)), TWO)
    cloud.fleet.edit([ManualClosure("a", 10.0, "b", 1010.0, (0.0, 0.0, 0.0), (0.01, 0.01))])
    a, b = cloud.finalize().robots
    assert a.map_index == b.map_index
    assert b.T_map_base == pytest.approx(a.T_map_base, abs=0.01)


def test_a_cut_leaves_the_path_and_takes_the_scans(scripted):
    cloud = feed(scripted(closures(A, B, PAIRS)), TWO)
    cloud.fleet.edit([Cut("b", 1010.0, 1060.0)])
    result = cloud.finalize()
    b = result.robots[1]
    assert len(b.stamps) == len(POSES)
    assert [keyscan.stamp for keyscan in b.keyscans] == [1000.0 + k for k in range(10)]
    held = [c.j.number for c in result.closures if c.status == "accepted"]
    assert all(number < 10 for number in held)


def test_a_cut_takes_the_closures_of_a_place_whose_submap_has_scans_of_it(scripted):
    """The place of a at 16 s is outside, but it was described on the scans from 12 s to 16 s."""
    cloud = feed(scripted(closures(A, B, [(k, k) for k in range(0, 61, 4)])), map(described_on_five_scans, TWO))
    cloud.fleet.edit([Cut("a", 14.2, 14.8)])
    assert {c.status for c in cloud.finalize().closures} == {"accepted"}, "no scan is in that"
    cut = Cut("a", 13.5, 15.5)
    cloud.fleet.edit([cut])
    assert {c.i.number for c in cloud.finalize().closures if c.status != "accepted"} == {16}
    cloud.fleet.edit([cut, ManualClosure("a", 16.0, "b", 1016.0, (0.0, 0.0, 0.0), (0.01, 0.01))])
    at_16 = [c.status for c in cloud.finalize().closures if c.i.number == 16]
    assert sorted(at_16) == ["accepted", "revoked"], "a closure by hand needs no submap"


def described_on_five_scans(packet):
    if not isinstance(packet.body, Place):
        return packet
    number = packet.body.id.number
    return replace(packet, body=replace(packet.body, first=max(0, number - 4), last=number))


def test_a_placement_moves_the_map_and_its_robots(scripted):
    cloud = feed(scripted(closures(A, B, PAIRS)), TWO)
    before = cloud.finalize()
    cloud.fleet.edit([Placement("b", 1000.0, (5.0, 5.0, 0.0)), Placement("a", 0.0, (100.0, -7.0, np.pi / 2))])
    after = cloud.finalize()
    T = np.array((100.0, -7.0, np.pi / 2))
    for old, new in zip(before.robots, after.robots, strict=True):
        assert new.T_map_base == pytest.approx(se2.compose(T, old.T_map_base), abs=1e-9)
        assert new.T_local_base == pytest.approx(old.T_local_base)
    for correction in cloud.fleet.corrections():
        assert correction.T_map_odom == pytest.approx(T, abs=1e-6), "both robots start at the same place"
    assert after.graph.poses()[0] == pytest.approx(T)


def test_a_region_moves_with_the_keyscan_to_which_it_is_tied(scripted):
    corners = ((0.0, 0.0), (1.0, 0.0), (1.0, 2.0))
    cloud = feed(scripted(closures(A, B, PAIRS)), TWO)
    region = MapRegion(RegionUse.ERASE, "", "b", 1025.3, corners)
    cloud.fleet.edit([region])
    (placed,) = cloud.finalize().regions
    b = cloud.finalize().robots[1]
    assert placed.polygon == pytest.approx(se2.transform(b.T_map_base[25], np.array(corners)))
    cloud.fleet.edit([region, Placement("a", 0.0, (1.0, 1.0, 1.0))])
    (moved,) = cloud.finalize().regions
    assert moved.polygon == pytest.approx(se2.transform(np.array((1.0, 1.0, 1.0)), placed.polygon))


def test_edits_survive_in_the_state_of_a_fleet(scripted, tmp_path):
    fleet = feed(scripted(closures(A, B, PAIRS[:1])), TWO).fleet
    changes = [Pin("a", "b", (0.0, 1000.0)), ManualClosure("a", 9.0, "b", 1009.0, (0.0, 0.0, 0.0), (0.1, 0.1))]
    fleet.edit(changes)
    again = restored(fleet, TWO, tmp_path / "state", changes=changes)
    assert fingerprint(again.estimate()) == fingerprint(fleet.estimate())
    assert fingerprint(again.conclude()) == fingerprint(fleet.conclude())
    again.edit([])
    assert map_of(again.conclude()) == {"a": 0, "b": 1}


def test_a_closure_by_hand_waits_for_its_keyscan(scripted):
    """A later keyscan may be nearer than the newest one."""
    made = ManualClosure("a", 10.0, "b", 1050.0, (0.0, 0.0, 0.0), (0.01, 0.01))
    cloud = feed(scripted(), TWO[:-80])
    cloud.fleet.edit([made])
    assert map_of(cloud.fleet.estimate()) == {"a": 0, "b": 1}
    feed(cloud, TWO[-80:])
    cloud.fleet.edit([made])
    a, b = cloud.fleet.estimate().robots
    assert a.map_index == b.map_index
    assert b.T_map_base[50] == pytest.approx(a.T_map_base[10], abs=0.01)
