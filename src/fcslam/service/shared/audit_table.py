"""The audit log as a table that all instances append to."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from fcslam.errors import StoreError
from fcslam.service.audit_log import AuditLog
from fcslam.storage.postgres import Postgres

_log = logging.getLogger(__name__)


class AuditTable(AuditLog):
    """Lines are written on a thread of its own, so no request waits for the store. A kill loses those that wait."""

    def __init__(self, server: Postgres, instance: str, wall_clock: Callable[[], float] = time.time) -> None:
        super().__init__(wall_clock)
        self._server, self._instance = server, instance
        self._writer = ThreadPoolExecutor(1, "audit log")

    def __str__(self) -> str:
        return f"{self._server.url}: the audit log"

    def append(self, line: bytes) -> None:
        """As in ``AuditLog``."""
        self._writer.submit(self._write, line.decode())

    def lines(self, limit: int) -> list[bytes]:
        """As in ``AuditLog``; lines of all instances."""
        rows = self._server.rows("SELECT entry FROM audit ORDER BY number DESC LIMIT ?", (limit,))
        return [entry.encode() for (entry,) in reversed(rows)]

    def close(self) -> None:
        """Write the lines that wait, and end."""
        self._writer.shutdown()

    def _write(self, line: str) -> None:
        try:
            self._server.rows("INSERT INTO audit (instance, entry) VALUES (?, ?) RETURNING 1", (self._instance, line))
        except StoreError as error:
            _log.error("%s; lost: %s", error, line)
