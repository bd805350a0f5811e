"""The tables of a store: made once, brought to later versions, and refused when they are of a newer one."""

import pytest

from fcslam.errors import StoreError
from fcslam.mission.mission_store import MissionStore
from fcslam.service.shared.mission_tables import MissionTables
from fcslam.service.shared.registry import Registry
from fcslam.service.shared.schema import MIGRATIONS, Migration, prepare
from fcslam.storage.postgres import Postgres


@pytest.fixture
def server(postgres, postgres_server):
    """A database of the test's own."""
    name = "versions"
    postgres.rows("SELECT 1")
    with postgres.connection("SELECT 1") as connection:
        connection.execute(f"DROP DATABASE IF EXISTS {name}")
        connection.execute(f"CREATE DATABASE {name}")
    server = Postgres(postgres.url.replace("/postgres", f"/{name}"), "tests")
    yield server
    server.close()


def version(server):
    return server.rows("SELECT number FROM fcslam.version")


def test_tables_are_made_once_and_brought_to_the_next_version_with_those_of_every_mission(server):
    prepare(server)
    prepare(server)
    assert version(server) == [(len(MIGRATIONS),)]
    number = Registry(server, "one", "one").create("kept")
    MissionStore(MissionTables(server, number)).progress(7, [])
    later = (*MIGRATIONS, Migration("CREATE TABLE more (x INT)", "CREATE TABLE notes (x INT)"))
    prepare(server, later)
    assert version(server) == [(len(later),)]
    tables = MissionTables(server, number)
    assert tables.rows("SELECT count(*) FROM notes") == [(0,)]
    assert server.rows("SELECT count(*) FROM more") == [(0,)]
    assert MissionStore(tables).applied() == 7


def test_a_migration_that_fails_changes_nothing(server):
    prepare(server)
    broken = (*MIGRATIONS, Migration("CREATE TABLE more (x INT)", ""), Migration("no statement", ""))
    with pytest.raises(StoreError, match="syntax"):
        prepare(server, broken)
    assert version(server) == [(len(MIGRATIONS),)]
    assert server.rows("SELECT to_regclass('fcslam.more') IS NULL") == [(True,)]


def test_a_store_of_a_newer_version_is_refused_in_one_line(server):
    prepare(server, (*MIGRATIONS, Migration("CREATE TABLE more (x INT)", "")))
    with pytest.raises(StoreError, match=r"a store of version 2; this fcslam reads version 1; install") as caught:
        prepare(server)
    assert "\n" not in str(caught.value)
