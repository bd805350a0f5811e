"""Damage in a mission's file is found before it is opened; what can be read again is the same, the rest is named."""

import contextlib
import shutil
import sqlite3

import numpy as np
import pytest

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import StoreError
from fcslam.records import Undo, Veto
from fcslam.service.mission_recovery import DAMAGED, recover_mission
from fcslam.service.mission_store import CONFIG, MissionStore, StoredPacket
from fcslam.storage.seals import PAGE_BYTES, seals_file
from fcslam.wire.messages import PacketKind

RNG = np.random.default_rng(1)
PACKETS = [
    StoredPacket(robot, 0, k, 0.5 * k, PacketKind.KEYSCAN, None, RNG.bytes(12_000 if k % 10 == 0 else 500))
    for k in range(60)
    for robot in ("a", "b")
]


def fill(path):
    store = MissionStore(path)
    store.configure(CloudConfig())
    for first in range(0, len(PACKETS), 10):
        store.put(PACKETS[first : first + 10], 1e9)
        if first == 60:
            with contextlib.closing(sqlite3.connect(path)) as connection:
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    store.refuse("b", 0, 7, "does not fit")
    store.edit(Veto("a", "b"), "boss", 1.0)
    store.edit(Undo(1), "boss", 2.0)
    store.answer(store.ask_to_finalize(), "1")
    store.progress(5, [])
    return store


def content(store):
    facts = store.fact(CONFIG), store.applied()
    return [packet for _, packet in store.arrivals(0, 1000)], store.edits(), store.finalizations(), facts


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """A mission whose service was stopped."""
    path = tmp_path_factory.mktemp("closed") / "mission.sqlite"
    store = fill(path)
    expected = content(store)
    store.close()
    return path, expected


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A mission whose service was killed, with transactions in the log, and without."""
    folder = tmp_path_factory.mktemp("killed")
    store = fill(folder / "open.sqlite")
    expected = content(store)
    for name in ("open.sqlite", "open.sqlite-wal"):
        shutil.copyfile(folder / name, folder / name.replace("open", "mission"))
    store.close()
    return folder / "mission.sqlite", expected


def copied(path, to):
    for file in path.parent.glob(f"{path.name}*"):
        shutil.copyfile(file, to / file.name)
    return to / path.name


def flip(path, at, by):
    with path.open("r+b") as file:
        file.seek(at)
        (before,) = file.read(1)
        file.seek(at)
        file.write(bytes((before ^ by,)))


def reopened(path):
    store = MissionStore(path)
    found = content(store)
    store.close()
    return found


@pytest.mark.parametrize("mission", ["closed", "killed"])
def test_what_is_not_damaged_is_left_alone(mission, request, tmp_path):
    path, expected = request.getfixturevalue(mission)
    path = copied(path, tmp_path)
    assert recover_mission(path) is None
    assert reopened(path) == expected
    assert not (tmp_path / "damaged").exists()


def test_every_flipped_byte_of_a_closed_mission_is_found_and_mended(closed, tmp_path):
    path, expected = closed
    rng = np.random.default_rng(2)
    for at in [18, 24, 50, 60, 100, *rng.integers(0, path.stat().st_size, 40).tolist()]:
        folder = tmp_path / str(at)
        folder.mkdir()
        damaged = copied(path, folder)
        flip(damaged, at, int(rng.integers(1, 256)))
        found = damaged.read_bytes()
        assert "mended" in recover_mission(damaged)
        assert damaged.read_bytes() == path.read_bytes()
        assert (folder / "damaged" / "1" / damaged.name).read_bytes() == found
        assert reopened(damaged) == expected


@pytest.mark.parametrize("name", ["mission.sqlite", "mission.sqlite-wal"])
def test_a_flipped_byte_after_a_kill_is_mended_or_what_it_took_is_refused(killed, tmp_path, name):
    path, (packets, *others) = killed
    rng = np.random.default_rng(3)
    for number, at in enumerate(rng.integers(0, path.with_name(name).stat().st_size, 60).tolist()):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        damaged = copied(path, folder)
        flip(damaged.with_name(name), at, int(rng.integers(1, 256)))
        recover_mission(damaged)
        found, *found_others = reopened(damaged)
        assert found_others == others
        assert set(found) <= {*packets, *lost(packets)}
        assert len(found) == len(packets)


def lost(packets):
    return [
        StoredPacket(packet.robot, packet.epoch, packet.sequence, 0.0, None, None, b"", DAMAGED) for packet in packets
    ]


def test_packets_of_a_lost_page_are_told_and_refused_and_the_others_recovered(closed, tmp_path):
    path, (packets, *others) = closed
    path = copied(path, tmp_path)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA writable_schema=1")
    (page,) = connection.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'packets'").fetchone()
    connection.close()
    wanted = packets[21].data[:100]
    at = path.read_bytes().index(wanted) // PAGE_BYTES
    assert at != page - 1
    with path.open("r+b") as file:
        file.seek(at * PAGE_BYTES)
        file.write(bytes(PAGE_BYTES))
    told = recover_mission(path)
    found, *found_others = reopened(path)
    gone = [packet for packet in packets if packet not in found]
    assert packets[21] in gone
    assert 1 <= len(gone) <= 8
    assert sorted(map(str, found)) == sorted(map(str, [*(p for p in packets if p not in gone), *lost(gone)]))
    assert f"packet {packets[21].sequence} of epoch 0 of {packets[21].robot}" in told
    assert found_others[0] == others[0]
    assert recover_mission(path) is None


@pytest.mark.parametrize("with_seals", [True, False])
def test_an_emptied_mission_is_not_a_new_one(closed, tmp_path, with_seals):
    path = copied(closed[0], tmp_path)
    path.write_bytes(b"")
    if not with_seals:
        seals_file(path).unlink()
    with pytest.raises(StoreError, match=r"the file is empty.*its configuration"):
        recover_mission(path)
    assert path.exists()


def test_a_cut_mission_is_recovered_as_far_as_it_goes(closed, tmp_path):
    path, (packets, *_) = closed
    path = copied(path, tmp_path)
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.truncate(size - 20 * PAGE_BYTES)
    assert "packets are recovered" in recover_mission(path)
    found, *_ = reopened(path)
    assert set(found) <= {*packets, *lost(packets)}
    assert len(set(found) & set(packets)) > len(packets) // 2


def test_a_file_that_was_changed_by_another_program_is_told(closed, tmp_path):
    path, expected = closed
    path = copied(path, tmp_path)
    connection = sqlite3.connect(path)
    connection.execute("VACUUM")
    connection.close()
    assert "outside of fcslam" in recover_mission(path)
    assert reopened(path) == expected
