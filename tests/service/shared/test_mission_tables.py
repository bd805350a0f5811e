"""A mission on a server is the same mission as in a file, and only the worker with its lease writes as its worker."""

import sqlite3
from contextlib import closing
from functools import partial

import numpy as np
import pytest

from fcslam.cloud.report import Track
from fcslam.cloud.settings import CloudConfig
from fcslam.errors import InputError, StoreError
from fcslam.mission.mission_store import FACTS, TABLES, MissionStore, StoredPacket, check_mission
from fcslam.records import Removal, Veto, frozen
from fcslam.service.mission_folder import KEPT, MissionFolder
from fcslam.service.shared.files import RESULT, SNAPSHOT, fetch_folder, fetch_snapshot, fetched, put_file
from fcslam.service.shared.mission_tables import LeaseLostError, MissionTables, insert_mission
from fcslam.storage.postgres import Postgres
from tests.full_disk import largest_file
from tests.mission.test_mission_store import correction, packet


def fill(store):
    store.configure(CloudConfig(seed=3))
    store.put([packet(sequence=k, data=bytes([k]) * 50) for k in range(30)], 12.25)
    store.put([StoredPacket("b", 1, 4, 0.1 + 0.2, None, None, b"?", "not readable"), packet("b", 1, 0)], 1e9 + 0.1)
    store.refuse([("a", 0, 7, "it does not fit: \N{LATIN SMALL LETTER A WITH DIAERESIS}")])
    for x in (0.0, 1.0 / 3.0, 2.0):
        store.progress(5, [correction("a", x), correction("b", -0.0, epoch=1)])
    store.edit(Veto("a", "b", (1.5, 2.5)), "boss", 5.0)
    store.edit(Removal("b"), "boss", 6.0)
    store.answer(store.ask_to_finalize(), "1")
    store.ask_to_finalize()
    track = Track(frozen(np.array([0.0, 0.1])), np.array([0, 0]), frozen(np.zeros((2, 3))))
    store.put_track("a", 0, track)


def rows(path):
    with closing(sqlite3.connect(path)) as file:
        return {
            table.name: file.execute(f"SELECT * FROM {table.name} ORDER BY {', '.join(table.key)}").fetchall()
            for table in TABLES
        }


def test_an_export_from_a_server_is_the_mission_file_that_a_file_gives(registry, postgres, tmp_path):
    on_disk = MissionStore(tmp_path / "mission.sqlite")
    on_server = MissionStore(MissionTables(postgres, registry.create("same")))
    for store, name in ((on_disk, "disk.sqlite"), (on_server, "server.sqlite")):
        fill(store)
        store.export(tmp_path / name)
        check_mission(tmp_path / name)
    found = rows(tmp_path / "server.sqlite")
    assert found == rows(tmp_path / "disk.sqlite")
    assert len(found["packets"]) == 32
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []
    with pytest.raises(StoreError):
        on_server.export(tmp_path / "disk.sqlite")
    on_disk.close()


def test_what_is_imported_is_exported_again(registry, postgres, tmp_path):
    store = MissionStore(tmp_path / "mission.sqlite")
    fill(store)
    store.export(tmp_path / "before.sqlite")
    store.close()
    tables = MissionTables(postgres, registry.create("imported", partial(insert_mission, tmp_path / "before.sqlite")))
    tables.export(tmp_path / "after.sqlite")
    assert rows(tmp_path / "after.sqlite") == rows(tmp_path / "before.sqlite")
    assert MissionStore(tables).put([packet(sequence=30)], 0.0) == 1


def test_of_an_import_that_fails_nothing_remains(registry, postgres, tmp_path):
    store = MissionStore(tmp_path / "mission.sqlite")
    fill(store)
    store.close()

    def cut(transaction):
        insert_mission(tmp_path / "mission.sqlite", transaction)
        assert transaction.execute("SELECT count(*) FROM packets").fetchall() == [(32,)]
        raise StoreError("the server is gone")

    with pytest.raises(StoreError):
        registry.create("half", cut)
    assert [mission.name for mission in registry.missions()] == []
    number = registry.create("half", partial(insert_mission, tmp_path / "mission.sqlite"))
    assert len(MissionStore(MissionTables(postgres, number)).envelopes()) == 32
    with pytest.raises(InputError, match="exists"):
        registry.create("half", cut)


def test_a_transaction_may_take_long_and_each_of_its_statements_not(registry, postgres):
    """As the export and the import of a large mission."""
    server = Postgres(postgres.url, "impatient", answer_s=0.5, retry_s=0.5)
    tables = MissionTables(server, registry.create("long"))
    with tables.transaction() as transaction:
        for k in range(10):
            transaction.insert(FACTS, [(f"fact {k}", "x")])
            transaction.execute("SELECT pg_sleep(0.3)")
    assert len(tables.rows("SELECT name FROM facts")) == 10
    with pytest.raises(StoreError, match="statement timeout"):
        tables.rows("SELECT pg_sleep(60)")
    server.close()


def test_a_worker_that_lost_its_lease_writes_nothing(registry, postgres, tmp_path):
    number = registry.create("fenced")
    MissionStore(MissionTables(postgres, number)).put([packet()], 0.0)
    (old,) = registry.claim(1)
    worker = MissionStore(MissionTables(postgres, number, old))
    (tmp_path / "snapshot").write_bytes(b"old")
    worker.progress(1, [correction("a", 1.0)])
    put_file(postgres, old, "snapshot", tmp_path / "snapshot")
    registry.release(old)
    (new,) = registry.claim(1)
    assert new.fence == old.fence + 1
    for write in (
        lambda: worker.progress(2, [correction("a", 9.0)]),
        lambda: worker.refuse([("a", 0, 0, "no")]),
        lambda: worker.answer(1, "1"),
        lambda: put_file(postgres, old, "snapshot", tmp_path / "missing"),
    ):
        (tmp_path / "missing").write_bytes(b"new")
        with pytest.raises(LeaseLostError, match="another worker has it"):
            write()
    assert worker.applied() == 1
    assert worker.correction("a", 0).correction.T_map_odom[0] == 1.0
    assert worker.refused("a").count == 0
    assert fetched(postgres, number, "snapshot") == b"old"
    MissionStore(MissionTables(postgres, number, new)).progress(2, [])
    assert worker.applied() == 2


def test_a_lease_is_not_taken_over_within_a_write_of_its_worker(registry, postgres):
    number = registry.create("writing")
    MissionStore(MissionTables(postgres, number)).put([packet()], 0.0)
    (lease,) = registry.claim(1)
    tables = MissionTables(postgres, number, lease)
    with tables.transaction() as transaction:
        registry.release(lease)  # as if it had expired
        assert registry.claim(1) == []
        transaction.execute("UPDATE packets SET received = 7.0")
    (taken,) = registry.claim(1)
    assert taken.fence == lease.fence + 1


def test_a_run_folder_travels_as_it_is(registry, postgres, tmp_path):
    number = registry.create("files")
    MissionStore(MissionTables(postgres, number)).put([packet()], 0.0)
    (lease,) = registry.claim(1)
    folder = tmp_path / "run"
    (folder / "trajectories").mkdir(parents=True)
    (folder / "trajectories" / "a.tum").write_bytes(bytes(range(256)))
    (folder / "map.png").write_bytes(b"png" * 1000)
    assert not fetch_folder(postgres, number, "live", tmp_path / "seen" / "1")
    put_file(postgres, lease, "live", folder)
    assert fetch_folder(postgres, number, "live", tmp_path / "seen" / "1")
    for path in (folder / "trajectories" / "a.tum", folder / "map.png"):
        assert (tmp_path / "seen" / "1" / path.relative_to(folder)).read_bytes() == path.read_bytes()
    (mission,) = registry.missions()
    assert mission.live == 1
    for k in range(1, KEPT + 3):
        put_file(postgres, lease, f"{RESULT}{k}", folder)
    kept = [k for k in range(KEPT + 3) if fetched(postgres, number, f"{RESULT}{k}") is not None]
    assert kept == list(range(3, KEPT + 3))


def test_a_worker_begins_without_the_snapshot_for_which_its_disk_has_no_room(registry, postgres, tmp_path):
    MissionStore(MissionTables(postgres, registry.create("full"))).put([packet()], 0.0)
    (lease,) = registry.claim(1)
    folder = MissionFolder(tmp_path)
    folder.snapshot.write_bytes(bytes(100_000))
    put_file(postgres, lease, SNAPSHOT, folder.snapshot)
    with largest_file(1000):
        fetch_snapshot(postgres, lease, folder)
    assert not folder.snapshot.exists(), "not half of it, and no older one"
    fetch_snapshot(postgres, lease, folder)
    assert folder.snapshot.read_bytes() == bytes(100_000)


def test_two_instances_number_their_packets_together(registry, postgres):
    number = registry.create("together")
    other = Postgres(postgres.url, "other")
    stores = [MissionStore(MissionTables(server, number)) for server in (postgres, other)]
    for k in range(40):
        stores[k % 2].put([packet("ab"[k % 2], sequence=k)], 0.0)
    assert [arrival for arrival, _ in stores[0].arrivals(0, 100)] == list(range(1, 41))
    assert stores[0].arrivals(0, 100) == stores[1].arrivals(0, 100)
    other.close()


def test_a_lost_connection_is_made_again_and_nothing_is_lost(registry, postgres, postgres_server):
    store = MissionStore(MissionTables(postgres, registry.create("restarted")))
    store.put([packet()], 0.0)
    postgres_server.stop()
    postgres_server.start()
    assert store.put([packet(sequence=1)], 0.0) == 1
    postgres_server.stop()
    postgres_server.start()
    assert [found.sequence for _, found in store.arrivals(0, 10)] == [0, 1]


def test_text_that_a_server_does_not_take_loses_no_packet(registry, postgres):
    store = MissionStore(MissionTables(postgres, registry.create("nul")))
    store.put([StoredPacket("a", 0, 0, 0.0, None, None, b"\0", "of \0 and \N{SNOWMAN}")], 0.0)
    ((_, found),) = store.arrivals(0, 1)
    assert found.data == b"\0"
    assert found.refusal == "of \N{REPLACEMENT CHARACTER} and \N{SNOWMAN}"


@pytest.mark.attack
@pytest.mark.parametrize("name", ["a'; DROP TABLE packets; --", "' OR '1'='1", "%s %(robot)s {0} ?1", 'a"b\\c$$'])
def test_names_that_look_like_statements_are_names(registry, postgres, name):
    other = MissionStore(MissionTables(postgres, registry.create("theirs")))
    other.put([packet(), packet("b")], 0.0)
    store = MissionStore(MissionTables(postgres, registry.create(name)))
    store.put([packet(name), packet()], 0.0)
    store.refuse([(name, 0, 0, name)])
    store.edit(Removal("a"), name, 1.0)
    store.progress(1, [correction(name, 1.0)])
    store.answer(store.ask_to_finalize(), name, name)
    assert name in [mission.name for mission in registry.missions()]
    assert [(p.robot, p.refusal) for _, p in store.arrivals(0, 9)] == [(name, name), ("a", None)]
    assert [(edit.author, edit.content) for edit in store.edits()] == [(name, Removal("a"))]
    assert store.correction(name, 0) is not None
    assert [(asked.run, asked.failure) for asked in store.finalizations()] == [(name, name)]
    assert (len(other.arrivals(0, 9)), other.refused(name).count, other.edits()) == (2, 0, [])
