"""The tables of a store: made once, brought to later versions, and refused when they are of a newer one."""

import pytest

from fcslam.errors import StoreError
from fcslam.mission.mission_store import MissionStore
from fcslam.service.shared.mission_tables import VERSION, MissionTables, prepare
from fcslam.service.shared.registry import Registry
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


def test_tables_are_made_once_and_kept(server):
    prepare(server)
    number = Registry(server, "one", "one").create("kept")
    MissionStore(MissionTables(server, number)).progress(7, [])
    prepare(server)
    assert version(server) == [(VERSION,)]
    assert MissionStore(MissionTables(server, number)).applied() == 7


def test_a_store_of_another_version_is_refused_in_one_line(server):
    prepare(server)
    server.rows("UPDATE fcslam.version SET number = 1 RETURNING 1")
    with pytest.raises(StoreError, match=r"a store of version 1; this fcslam reads version 2") as caught:
        prepare(server)
    assert "\n" not in str(caught.value)
