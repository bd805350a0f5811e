"""The audit log as a table that all instances append to."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from fcslam.errors import StoreError
from fcslam.service.audit_log import AuditLog
from fcslam.storage.postgres import Postgres

_MOST_WAITING = 10_000
"""Lines that wait for the store; of more, the service's own log has the text."""

_log = logging.getLogger(__name__)


class AuditTable(AuditLog):
    """Lines wait for the store on a thread of its own, so no request does. A kill loses those that wait."""

    def __init__(self, server: Postgres, instance: str, wall_clock: Callable[[], float] = time.time) -> None:
        super().__init__(wall_clock)
        self._server, self._instance = server, instance
        self._waiting: queue.Queue[bytes | None] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._write, name="audit log", daemon=True)
        self._thread.start()

    def __str__(self) -> str:
        return f"{self._server.url}: the audit log"

    def append(self, line: bytes) -> None:
        """As in ``AuditLog``."""
        try:
            self._waiting.put_nowait(line)
        except queue.Full as error:
            raise OSError("the store does not answer") from error

    def lines(self, limit: int) -> list[bytes]:
        """As in ``AuditLog``; lines of all instances."""
        rows = self._server.rows("SELECT entry FROM audit ORDER BY number DESC LIMIT ?", (limit,))
        return [entry.encode() for (entry,) in reversed(rows)]

    def close(self) -> None:
        """Write the lines that wait, and end."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
        self._thread.join(10.0)

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            try:
                statement = "INSERT INTO audit (instance, entry) VALUES (?, ?) RETURNING 1"
                self._server.rows(statement, (self._instance, line.decode()))
            except StoreError as error:
                _log.error("%s; lost: %s", error, line.decode())
