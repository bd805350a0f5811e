"""A mission's file is served as it was written, or refused in one line; a kill takes nothing that was stored."""

import re
import shutil

import numpy as np
import pytest

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import StoreError
from fcslam.mission.mission_store import CONFIG, MissionStore, StoredPacket
from fcslam.records import Undo, Veto
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
    store.edit(Veto("a", "b"), "boss", 1.0)
    store.edit(Undo(1), "boss", 2.0)
    store.answer(store.ask_to_finalize(), "1")
    for first in range(0, len(PACKETS), 10):
        store.put(PACKETS[first : first + 10], 1e9)
    return store


def content(store):
    return [packet for _, packet in store.arrivals(0, 1000)], store.edits(), store.finalizations(), store.fact(CONFIG)


@pytest.fixture(scope="module")
def missions(tmp_path_factory):
    """Missions whose service was stopped, and killed with transactions in the log; and their content."""
    folder = tmp_path_factory.mktemp("missions")
    store = fill(folder / "killed.sqlite")
    expected = content(store)
    (folder / "killed").mkdir()
    for name in ("killed.sqlite", "killed.sqlite-wal"):
        shutil.copyfile(folder / name, folder / "killed" / name.replace("killed", "mission"))
    store.close()
    (folder / "closed").mkdir()
    (folder / "killed.sqlite").rename(folder / "closed" / "mission.sqlite")
    return folder, expected


def closed(missions, folder):
    """Where a test puts a mission, and the content of one whose service was stopped."""
    return folder / "mission.sqlite", (missions[0] / "closed" / "mission.sqlite").read_bytes()


def reopened(path):
    """The mission's content, or why it is refused."""
    try:
        store = MissionStore(path)
    except StoreError as error:
        return str(error)
    found = content(store)
    store.close()
    return found


def flipped(data, at, by):
    return data[:at] + bytes((data[at] ^ by,)) + data[at + 1 :]


def assert_refused(path, match):
    told = reopened(path)
    assert isinstance(told, str)
    assert re.fullmatch(f"{re.escape(str(path))}: {match}", told)


@pytest.mark.parametrize("kind", ["closed", "killed"])
def test_a_mission_that_is_not_damaged_is_served_as_it_was(missions, tmp_path, kind):
    folder, expected = missions
    assert reopened(shutil.copytree(folder / kind, tmp_path / kind) / "mission.sqlite") == expected


def test_a_packet_with_a_changed_byte_is_refused(missions, tmp_path):
    path, whole = closed(missions, tmp_path)
    rng = np.random.default_rng(2)
    for number in (0, 1, 20, 40, *range(2, 118, 5)):
        data = PACKETS[number].data[6000:6008] or PACKETS[number].data  # a large one is in several pages
        at = whole.index(data) + int(rng.integers(0, len(data)))
        path.write_bytes(flipped(whole, at, int(rng.integers(1, 256))))
        assert_refused(
            path, r"damaged or cut off \(1 rows of packets have a wrong checksum\); put its backup in its place"
        )


@pytest.mark.parametrize(
    ("kind", "name"),
    [("closed", "mission.sqlite"), ("killed", "mission.sqlite"), ("killed", "mission.sqlite-wal")],
)
def test_after_any_changed_byte_nothing_wrong_is_served(missions, tmp_path, kind, name):
    """SQLite reads its log until the first damaged transaction, so those before it count."""
    folder, (packets, *others) = missions
    path = shutil.copytree(folder / kind, tmp_path / kind) / "mission.sqlite"
    rng = np.random.default_rng(3)
    whole, refused = (folder / kind / name).read_bytes(), 0
    for at in [0, 16, 18, 24, 50, 60, 100, *rng.integers(0, len(whole), 60).tolist()]:
        shutil.copytree(folder / kind, path.parent, dirs_exist_ok=True)
        path.with_name(name).write_bytes(flipped(whole, at, int(rng.integers(1, 256))))
        outcome = reopened(path)
        if isinstance(outcome, str):
            refused += 1
            assert outcome.startswith(f"{path}: ")
            assert "\n" not in outcome
        else:
            found, *found_others = outcome
            assert found == packets[: len(found)]
            assert found_others == others or not found
            assert len(found) == len(packets) or name.endswith("-wal")
    assert refused > 30 or kind == "killed"


DAMAGE = {
    **{f"cut at {share}": lambda whole, share=share: whole[: int(share * len(whole))] for share in (0.02, 0.5, 0.99)},
    "lost tables": lambda whole: whole[:103] + bytes(2) + whole[105:],  # the number of rows in the schema's page
    "a text that is not UTF-8": lambda whole: whole.replace(b"boss", b"b\xffss"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_mission_is_refused_and_stays_as_it_is(missions, tmp_path, kind):
    path, whole = closed(missions, tmp_path)
    damaged = DAMAGE[kind](whole)
    path.write_bytes(damaged)
    assert_refused(path, "damaged or cut off .*; put its backup in its place")
    assert path.read_bytes() == damaged


def test_what_is_damaged_while_it_is_open_gets_into_no_backup(missions, tmp_path):
    path = shutil.copytree(missions[0] / "closed", tmp_path / "data") / "mission.sqlite"
    store, whole = MissionStore(path), path.read_bytes()
    with path.open("r+b") as file:
        file.seek(whole.index(PACKETS[2].data))
        file.write(b"damage")
    with pytest.raises(StoreError, match=f"{path}: damaged .*wrong checksum"):
        store.export(tmp_path / "backup.sqlite")
    assert [found.name for found in tmp_path.iterdir()] == ["data"]
    store.close()
