"""Files as rows: a worker's snapshot for the next worker, run folders and detectors for every instance."""

import io
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from fcslam.records import Channel, DetectorFile
from fcslam.service.detectors import DetectorStore
from fcslam.service.mission_folder import KEPT, MissionFolder
from fcslam.service.shared.mission_tables import Lease, check_lease, schema_of
from fcslam.storage.database import translate_errors
from fcslam.storage.files import replacing_folder, write_file
from fcslam.storage.postgres import Postgres, PostgresTransaction

SNAPSHOT: Final = "snapshot"
LIVE: Final = "live"
JOINT: Final = "joint"
RESULT: Final = "result "
"""Names of what is shared; that of a result ends with its number."""


def put_file(server: Postgres, lease: Lease, name: str, path: Path) -> None:
    """Store a file, or a folder as one file, of a worker with a lease in place of the one of this name.

    Raises:
        StoreError: it cannot be stored.
        LeaseLostError: another worker has the mission.
    """
    with translate_errors(path):
        content = _packed(path) if path.is_dir() else path.read_bytes()
    # Without the lock of those who store packets: this may take a while.
    with server.connection(f"BEGIN; SET LOCAL search_path TO {schema_of(lease.mission)}") as connection:
        transaction = PostgresTransaction(server, connection)
        check_lease(transaction, lease)
        transaction.execute(
            "INSERT INTO files VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET content = excluded.content",
            (name, content),
        )
        if name.startswith(RESULT):
            old = [f"{RESULT}{number}" for number in range(int(name.removeprefix(RESULT)) - KEPT + 1)]
            transaction.execute("DELETE FROM files WHERE name = ANY(?)", (old,))
        counted = "live" if name == LIVE else "finalized" if name.startswith(RESULT) else None
        if counted is not None:
            statement = f"UPDATE fcslam.missions SET {counted} = {counted} + 1 WHERE number = ?"
            transaction.execute(statement, (lease.mission,))
        connection.execute("COMMIT")


def fetch_snapshot(server: Postgres, lease: Lease, folder: MissionFolder) -> None:
    """Write the snapshot of the worker before into a mission's folder, if the disk has room for it."""
    found = fetched(server, lease.mission, SNAPSHOT)
    with suppress(OSError):  # the disk is full: the worker applies all packets again
        folder.snapshot.unlink(missing_ok=True)
        if found is not None:
            write_file(folder.snapshot, found)


def fetched(server: Postgres, mission: int, name: str) -> bytes | None:
    """A shared file; None if the mission has no file ``name``."""
    rows = server.rows("SELECT content FROM files WHERE name = ?", (name,), schema_of(mission))
    return bytes(rows[0][0]) if rows else None


def fetch_folder(server: Postgres, mission: int, name: str, path: Path) -> bool:
    """Write a shared run folder to ``path``; False if the mission has no folder ``name``."""
    content = fetched(server, mission, name)
    if content is None:
        return False
    with translate_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing_folder(path) as unfinished, zipfile.ZipFile(io.BytesIO(content)) as archive:
            archive.extractall(unfinished)
    return True


def _packed(folder: Path) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder))
    return content.getvalue()


class SharedDetectors(DetectorStore):
    """A folder that follows the table of detectors."""

    def __init__(self, root: Path, server: Postgres) -> None:
        super().__init__(root)
        self._server = server

    def announce(self, content: bytes) -> DetectorFile:
        """Add a network and announce it to the robots of all instances."""
        file = super().announce(content)
        self._server.rows(
            "INSERT INTO detectors (channel, version, content) VALUES (?, ?, ?)"
            " ON CONFLICT (channel, version) DO UPDATE SET number = DEFAULT RETURNING 1",
            (file.channel, file.version, content),
        )
        return file

    def follow(self) -> None:
        """Announce what another instance announced."""
        newest = self._server.rows(
            "SELECT DISTINCT ON (channel) channel, version, number FROM detectors ORDER BY channel, number DESC"
        )
        announced = self.announced()
        for channel, version, number in newest:
            known = announced.get(Channel(channel))
            if known is None or known.version != version:
                ((content,),) = self._server.rows("SELECT content FROM detectors WHERE number = ?", (number,))
                super().announce(bytes(content))
