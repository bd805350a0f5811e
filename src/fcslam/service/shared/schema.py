"""The tables on a PostgreSQL server.

The schema ``fcslam`` holds what all missions share; each mission has a schema of its own with the tables of a mission
file.
"""

import re
from typing import Final

from fcslam.errors import StoreError
from fcslam.mission.mission_store import SCHEMA
from fcslam.storage.postgres import Postgres

VERSION: Final = 1
"""Version of the tables."""
LOCK: Final = 0x0FC51A  # of fcslam's, in case other programs lock as well
"""The lock of whoever makes the tables, and first number of the locks of those who write to a mission."""
SHARED: Final = """
CREATE TABLE missions (
    number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    name TEXT COLLATE "C" NOT NULL UNIQUE,
    is_open BOOLEAN NOT NULL DEFAULT false,
    is_wanted BOOLEAN NOT NULL DEFAULT false,
    holder TEXT, fence BIGINT NOT NULL DEFAULT 0, expires TIMESTAMPTZ NOT NULL DEFAULT '-infinity',
    is_ready BOOLEAN NOT NULL DEFAULT false,
    live BIGINT NOT NULL DEFAULT 0, finalized BIGINT NOT NULL DEFAULT 0
);
CREATE UNIQUE INDEX one_open ON missions (is_open) WHERE is_open;
CREATE TABLE instances (
    name TEXT COLLATE "C" PRIMARY KEY, process TEXT NOT NULL, room BIGINT NOT NULL, expires TIMESTAMPTZ NOT NULL
);
CREATE TABLE audit (
    number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, instance TEXT NOT NULL, entry TEXT NOT NULL
);
CREATE TABLE detectors (
    number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    channel TEXT NOT NULL, version TEXT NOT NULL, content BYTEA NOT NULL, UNIQUE (channel, version)
)
"""
_TYPES: Final = {
    "INTEGER": "BIGINT",
    "REAL": "DOUBLE PRECISION",
    "BLOB": "BYTEA",
    "TEXT": 'TEXT COLLATE "C"',
    " STRICT": "",
}
"""Words of a mission file's schema, and what they are here; only rows of a file have seals."""
_UNSEALED: Final = re.sub(r",\s*seal BLOB NOT NULL", "", SCHEMA)
MISSION: Final = (
    re.sub("|".join(_TYPES), lambda word: _TYPES[word[0]], _UNSEALED).rstrip()
    + """;
CREATE TABLE files (name TEXT COLLATE "C" PRIMARY KEY, number BIGINT NOT NULL, content BYTEA NOT NULL);
CREATE TABLE agents (robot TEXT COLLATE "C" PRIMARY KEY, agent TEXT NOT NULL, heard TIMESTAMPTZ NOT NULL)
"""
)


def schema_of(number: int) -> str:
    """Name of a mission's schema."""
    return f"fcslam_mission_{number}"


def prepare(server: Postgres) -> None:
    """Make the tables on a server that has none."""
    with server.connection(f"BEGIN; SELECT pg_advisory_xact_lock({LOCK})") as connection:
        found = connection.execute("SELECT to_regclass('fcslam.version') IS NOT NULL").fetchone()
        if not (found and found[0]):
            connection.execute("CREATE SCHEMA IF NOT EXISTS fcslam")
            connection.execute(f"SET LOCAL search_path TO fcslam; {SHARED}".encode())
            connection.execute("CREATE TABLE fcslam.version (number BIGINT NOT NULL)")
            connection.execute(f"INSERT INTO fcslam.version VALUES ({VERSION})".encode())
        (version,) = connection.execute("SELECT number FROM fcslam.version").fetchone() or (0,)
        if version != VERSION:
            raise StoreError(f"{server.url}: a store of version {version}; this fcslam reads version {VERSION}")
        connection.execute("COMMIT")


def mission_statements(number: int) -> bytes:
    """Statements that make the tables of a new mission."""
    return f"CREATE SCHEMA {schema_of(number)}; SET LOCAL search_path TO {schema_of(number)}; {MISSION}".encode()
