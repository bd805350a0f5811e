"""Edits: what users change by hand takes effect at once, exactly in the result, and can be undone."""

from dataclasses import replace

import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.edits import check_undo, edit_json, in_force, is_removed, kind_of, read_edit
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import EditError
from fcslam.records import Edit, Removal, Undo, Veto
from fcslam.storage.state_file import read_state, write_state
from tests.scripted import ALIAS, closures, rectangle, stream
from tests.small_fleet import feed, fingerprint, in_order, map_of

POSES = rectangle()
A, B, C = ("a", POSES), ("b", POSES), ("c", POSES)
PAIRS = [(0, 0), (8, 8), (16, 16), (24, 24), (32, 32), (40, 40)]
CONTENTS = [Veto("a", "b"), Veto("a", "a", (1.5, 2.0)), Removal("b"), Removal("a", 3), Undo(7)]


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
    ],
)  # fmt: skip
def test_what_is_no_edit_is_refused(kind, content):
    with pytest.raises(EditError):
        read_edit(kind, content)


def test_in_force_is_what_nothing_undid():
    edits = log(Veto("a", "b"), Removal("b"), Undo(1), Removal("b"), Undo(2))
    assert in_force(edits) == (Removal("b"),)
    check_undo(edits, 4)
    for number in (0, 1, 2, 3, 6):
        with pytest.raises(EditError):
            check_undo(edits, number)


def test_a_removal_covers_a_robot_or_one_session():
    assert [is_removed(name, [Removal("b")]) for name in ("a", "b", "b+1", "bb")] == [False, True, True, False]
    assert [is_removed(name, [Removal("b", 1)]) for name in ("b", "b+1", "b+11")] == [False, True, False]


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
    honest = feed(scripted(*LIES), [packet for packet in with_liar() if packet.robot != "b"])
    assert fingerprint(cloud.finalize()) == fingerprint(honest.finalize())


@pytest.mark.parametrize("when", ["before", "midway", "after"])
def test_the_result_is_what_it_would_have_been_without_the_robot(packets, when):
    removed = packets[0].robot
    cut = {"before": 0, "midway": len(packets) // 2, "after": len(packets)}[when]
    cloud = feed(Cloud(FleetConfig(), 0), packets[:cut])
    cloud.fleet.edit([Removal(removed)])
    feed(cloud, packets[cut:])
    without = feed(Cloud(FleetConfig(), 0), [packet for packet in packets if packet.robot != removed])
    assert fingerprint(cloud.finalize()) == fingerprint(without.finalize())
    assert set(map_of(cloud.fleet.estimate())) == set(map_of(without.fleet.estimate()))


def test_only_the_named_session_is_removed(scripted):
    starts = [replace(p, epoch=1, body=replace(p.body, epoch=1)) if p.sequence == 0 else replace(p, epoch=1)
              for p in stream("a", POSES, start_s=500.0)]  # fmt: skip
    cloud = feed(scripted(), [*stream("a", POSES, start_s=0.0), *starts])
    assert set(map_of(cloud.finalize())) == {"a", "a+1"}
    cloud.fleet.edit([Removal("a", 1)])
    assert set(map_of(cloud.fleet.estimate())) == set(map_of(cloud.finalize())) == {"a"}


def test_a_removal_survives_in_the_state_of_a_fleet(scripted, tmp_path):
    fleet = feed(scripted(*LIES), with_liar()).fleet
    fleet.edit([Removal("b"), Veto("a", "c", (1.0, 2.0))])
    write_state(tmp_path / "state", "test", fleet.state())
    stored = {PacketNumber(packet.robot, packet.sequence): packet for packet in with_liar()}
    again = Fleet.restored(FleetConfig(), 0, read_state(tmp_path / "state", "test"), stored.__getitem__)
    assert fingerprint(again.estimate()) == fingerprint(fleet.estimate())
    with pytest.raises(ValueError, match="come back"):
        again.edit([Veto("a", "c", (1.0, 2.0))])


def test_a_veto_that_is_undone_leaves_no_trace_in_the_result(scripted):
    robots = [*stream(*A, start_s=0.0), *stream(*B, start_s=1000.0)]
    cloud = feed(scripted(closures(A, B, PAIRS)), robots[:-20])
    cloud.fleet.edit([Veto("a", "b")])
    assert cloud.fleet.closure_counts()["between robots"] == 0
    cloud.finalize()
    feed(cloud, robots[-20:])
    cloud.fleet.edit([])
    assert map_of(cloud.fleet.estimate()) == {"a": 0, "b": 0}
    assert fingerprint(cloud.finalize()) == fingerprint(feed(scripted(closures(A, B, PAIRS)), robots).finalize())
