"""Packets are stored once and unchanged, in the order of their arrival, in a file and on a PostgreSQL server."""

import contextlib
import os
import secrets
import sqlite3
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.cloud.replies import NEWS_M, NEWS_RAD, SessionCorrection
from fcslam.errors import InputError, PacketConflictError, StoreError
from fcslam.geometry import se3
from fcslam.mission.mission_store import EDITS, FACTS, PACKETS, MissionStore, StoredPacket, check_mission
from fcslam.records import Channel, Correction, Edit, Removal, Undo, Veto, frozen
from fcslam.service.shared.mission_tables import MissionTables
from fcslam.service.shared.registry import Registry
from fcslam.storage.database import SealedConnection, seal
from fcslam.storage.row_store import change_rows
from fcslam.wire.messages import PacketKind
from tests.full_disk import largest_file

pytestmark = pytest.mark.slow

NUMBERS = st.tuples(st.sampled_from(["a", "b"]), st.integers(0, 2), st.integers(0, 12))
BATCHES = st.lists(st.lists(NUMBERS, max_size=8), max_size=12)


def packet(robot="a", epoch=0, sequence=0, data=None) -> StoredPacket:
    content = f"{robot} {epoch} {sequence}".encode() if data is None else data
    return StoredPacket(robot, epoch, sequence, 0.5 * sequence, PacketKind.PLACE, Channel.CAMERA, content)


def place_of(kind, folder, request):
    """Opens a mission in a file or on a PostgreSQL server."""
    if kind == "file":
        return lambda: MissionStore(folder / "mission.sqlite")
    server = request.getfixturevalue("postgres")
    number = Registry(server, "tests", "tests").create(f"m{secrets.token_hex(8)}")
    return lambda: MissionStore(MissionTables(server, number))


@pytest.fixture(params=["file", "server"])
def place(request, tmp_path):
    """Each test of a store is one of both stores."""
    return place_of(request.param, tmp_path, request)


@pytest.fixture
def store(place):
    store = place()
    yield store
    store.close()


def correction(robot, x, epoch=0, y=0.0, theta=0.0, map_index=0, quality=0.25):
    return SessionCorrection(robot, epoch, 1.0, Correction(robot, 0, map_index, frozen((x, y, theta)), quality))


def stored(store):
    return [packet for _, packet in store.arrivals(0, 1000)]


@given(batches=BATCHES)
@pytest.mark.parametrize("kind", ["file", "server"])
def test_packets_are_stored_once_in_the_order_of_their_arrival(kind, batches, tmp_path_factory, request):
    place = place_of(kind, tmp_path_factory.mktemp("store"), request)
    store = place()
    expected: dict[tuple[str, int, int], None] = {}
    for batch in batches:
        new = store.put([packet(*number) for number in batch], received_s=1.0)
        assert new == len(set(batch) - expected.keys())
        expected |= dict.fromkeys(batch)
        assert stored(store) == [packet(*number) for number in expected]
    arrivals = store.arrivals(0, 1000)
    assert [arrival for arrival, _ in arrivals] == list(range(1, len(expected) + 1))
    assert [e[:3] for e in store.envelopes()] == list(expected)
    store.close()
    again = place()
    assert again.arrivals(0, 1000) == arrivals
    again.close()


def test_arrivals_can_be_read_in_pieces(store):
    store.put([packet(sequence=k) for k in range(7)], 0.0)
    assert [p.sequence for after in (0, 3, 6) for _, p in store.arrivals(after, 3)] == list(range(7))
    assert [e.sequence for e in store.envelopes(until=4)] == [0, 1, 2, 3]


def test_another_packet_with_the_same_number_is_a_conflict_and_those_before_it_are_stored(store):
    store.put([packet(sequence=1)], 0.0)
    with pytest.raises(PacketConflictError, match="other content") as caught:
        store.put([packet(sequence=0), packet(sequence=1, data=b"other"), packet(sequence=2)], 0.0)
    assert caught.value.index == 1
    assert [p.data for p in stored(store)] == [b"a 0 1", b"a 0 0"]


def test_a_batch_that_fails_in_the_middle_leaves_nothing(store):
    store.put([packet(sequence=0)], 0.0)
    with pytest.raises(StoreError, match=r"full|null value"):
        store.put([packet(sequence=1), replace(packet(sequence=2), data=None)], 0.0)  # type: ignore[arg-type]
    assert [p.sequence for p in stored(store)] == [0]
    store.put([packet(sequence=1)], 0.0)
    assert [p.sequence for p in stored(store)] == [0, 1]


def test_a_full_disk_is_told_and_what_was_there_stays(tmp_path):
    store = MissionStore(tmp_path / "mission.sqlite")
    store.put([packet()], 0.0)
    used = (tmp_path / "mission.sqlite-wal").stat().st_size
    with largest_file(used + 10_000), pytest.raises(StoreError, match="is the disk full"):
        store.put([packet(sequence=k, data=bytes(4096)) for k in range(1, 9)], 0.0)
    assert stored(store) == [packet()]
    store.put([packet(sequence=k, data=bytes(4096)) for k in range(1, 9)], 0.0)
    assert len(stored(store)) == 9
    store.close()


def test_what_another_process_wrote_is_seen(store, place):
    other = place()
    other.put([packet()], 0.0)
    other.refuse([("a", 0, 0, "no good")])
    assert store.refusals("a") == [(0, 0, "no good")]
    assert store.packets([("a", 0, 0)])["a", 0, 0].refusal == "no good"
    other.close()


@pytest.mark.parametrize("reopened", [False, True])
def test_versions_of_corrections_grow_with_every_change_and_with_nothing_else(place, reopened):
    store = place()
    told = []
    for x in (0.0, 0.0, 1.0, 1.0, 0.0):
        store.progress(5, [correction("a", x), correction("b", 3.0)])
        if reopened:
            store.close()
            store = place()
        versions = {robot: store.correction(robot, 0).correction.version for robot in "ab"}
        told.append((x, versions["a"], versions["b"]))
    assert [x for x, *_ in told] == [0.0, 0.0, 1.0, 1.0, 0.0]
    a = [version for _, version, _ in told]
    assert a[0] == a[1] < a[2] == a[3] < a[4]
    assert len({b for *_, b in told}) == 1
    assert np.array_equal(store.correction("a", 0).correction.T_map_odom, (0.0, 0.0, 0.0))
    assert store.correction("a", 1) is None
    assert store.applied() == 5
    store.close()


def test_a_correction_in_space_keeps_all_numbers_and_its_height_is_news(store):
    pose = se3.exp((1.0, -2.0, 0.3, 0.01, -0.02, 1.5))
    for height_m in (0.0, 0.0, 0.1):
        moved = se3.compose(se3.exp((0.0, 0.0, height_m, 0.0, 0.0, 0.0)), pose)
        store.progress(1, [correction("a", 1.0), SessionCorrection("b", 0, 1.0, Correction("b", 0, 0, frozen(moved)))])
        assert store.correction("b", 0).correction.T_map_odom.tobytes() == moved.tobytes()
    assert store.correction("b", 0).correction.version == 2
    assert store.correction("a", 0).correction.T_map_odom.shape == (3,)


@pytest.mark.parametrize("axis", ["x", "y", "theta"])
def test_what_a_robot_believes_creeps_no_further_away_than_what_is_news(store, axis):
    """Many steps, each too small for a report, are reported when their sum is large enough."""
    limit = NEWS_RAD if axis == "theta" else NEWS_M
    versions = []
    for step in range(100):
        truth = {"x": 3.0, axis: -0.3 * limit * step}
        store.progress(step, [correction("a", **truth)])
        told = store.correction("a", 0).correction
        assert np.abs(told.T_map_odom - correction("a", **truth).correction.T_map_odom).max() < limit
        versions.append(told.version)
    assert 20 < len(set(versions)) < 35
    assert versions == sorted(versions)


def test_edits_and_requests_are_kept_in_their_order(store):
    contents = [Veto("a", "b"), Veto("a", "a", (1.5, 2.5)), Removal("b"), Removal("a", 3), Undo(3)]
    edits = [store.edit(content, "boss", float(k)) for k, content in enumerate(contents)]
    assert edits == [Edit(k + 1, "boss", float(k), content) for k, content in enumerate(contents)]
    store.put([packet()], 0.0)
    number = store.ask_to_finalize()
    asked = store.finalization(number)
    assert (asked.arrivals, asked.edits, asked.run) == (1, 5, None)
    store.answer(number, "1")
    assert store.finalization(number).run == "1"
    assert store.edits() == edits
    assert store.edits(3) == edits[3:]


@pytest.mark.parametrize(
    ("number", "told"), [(1, "before, by edit 2"), (2, "again"), (4, "shows all 3")], ids=["twice", "an undo", "none"]
)
def test_what_cannot_be_undone_changes_nothing(store, number, told):
    for content in (Veto("a", "b"), Undo(1), Removal("a")):
        store.edit(content, "boss", 0.0)
    with pytest.raises(InputError, match=told):
        store.edit(Undo(number), "boss", 0.0)
    assert len(store.edits()) == 3


def test_an_export_is_the_mission_and_nothing_else_is(store, tmp_path):
    store.put([packet(sequence=k) for k in (0, 1, 5)], 0.0)
    store.export(tmp_path / "out.sqlite")
    check_mission(tmp_path / "out.sqlite")
    copy = MissionStore(tmp_path / "out.sqlite")
    assert copy.arrivals(0, 10) == store.arrivals(0, 10)
    copy.close()
    with pytest.raises(StoreError):
        store.export(tmp_path / "out.sqlite")


def test_packets_are_stored_while_an_export_is_written(store, tmp_path, monkeypatch):
    store.put([packet()], 0.0)
    link = os.link

    def meanwhile(*paths):
        storing = threading.Thread(target=store.put, args=([packet(sequence=1)], 0.0), daemon=True)
        storing.start()
        storing.join(120.0)
        assert not storing.is_alive()
        link(*paths)

    monkeypatch.setattr(os, "link", meanwhile)
    store.export(tmp_path / "out.sqlite")
    assert len(stored(store)) == 2
    copy = MissionStore(tmp_path / "out.sqlite")
    assert len(stored(copy)) == 1
    copy.close()


@pytest.mark.parametrize("harm", ["trigger", "view", "kind", "channel", "none", "config", "edit", "undo"])
def test_a_file_that_is_no_mission_is_refused(store, tmp_path, harm):
    path = tmp_path / "out.sqlite"
    store.put([packet(sequence=k, data=bytes(4000)) for k in range(20)], 0.0)
    store.export(path)
    connection = sqlite3.connect(path, factory=SealedConnection)
    connection.create_function("seal", -1, seal)
    changes = {"kind": {"kind": "rumour"}, "channel": {"channel": "smell"}, "none": {"kind": None}}
    rows = {
        "edit": (EDITS, (1, "boss", 0.0, "removal", '{"robot": 1}')),
        "undo": (EDITS, (1, "boss", 0.0, "undo", '{"number": 1}')),
        "config": (FACTS, ("config", '{"seed": "x"}')),
    }
    statements = {
        "trigger": "CREATE TRIGGER t AFTER INSERT ON edits BEGIN DELETE FROM packets; END",
        "view": "CREATE VIEW v AS SELECT 1",
    }
    if harm in changes:
        change_rows(connection, PACKETS, changes[harm], "sequence = ?", (3,))
    elif harm in rows:
        table, row = rows[harm]
        connection.insert(table, [row])
    else:
        connection.execute(statements[harm])
    connection.commit()
    connection.close()
    with pytest.raises(StoreError):
        check_mission(path)


def test_the_time_for_a_packet_does_not_grow_with_the_mission(tmp_path):
    """No statement that a packet or a reply to a robot needs reads all packets; SQLite calls that a scan."""
    path, opened, statements = tmp_path / "mission.sqlite", [], []
    sys.addaudithook(
        lambda event, of: opened is not None and event == "sqlite3.connect/handle" and opened.append(of[0])
    )
    store = MissionStore(path)
    store.put([packet(robot, sequence=k) for robot in "ab" for k in range(20)], 1.0)
    connections, opened = opened, None
    for connection in connections:
        with contextlib.suppress(sqlite3.ProgrammingError):  # one that is closed
            connection.set_trace_callback(statements.append)
    del connection, connections
    store.put([packet(sequence=k) for k in range(15, 25)], 2.0)
    store.progress(40, [correction("a", 1.0)])
    store.arrivals(30, 10)
    store.packets([("a", 0, 3)])
    store.correction("a", 0)
    store.newest_hello("a", 0)
    store.newest_keyscan("a", 0)
    store.refused("a")
    store.envelopes(after=30)
    store.traffic_since(30, 10)
    store.close()
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.create_function("seal", -1, seal)
        queries = [statement for statement in statements if "packets" in statement]
        plans = {query: [row[3] for row in database.execute(f"EXPLAIN QUERY PLAN {query}")] for query in queries}
    assert len(plans) >= 9
    assert not {query: plan for query, plan in plans.items() if any("SCAN packets" in step for step in plan)}
