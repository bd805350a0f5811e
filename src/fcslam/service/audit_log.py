"""The audit log: who did what to the service, as lines of JSON that are only ever appended."""

import json
import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fcslam.errors import StoreError
from fcslam.storage.postgres import Postgres

REFUSED_EVERY_S = 60.0
"""Refused logins make one line in this time at most, so no client without a token can fill the disk."""
READ_BYTES = 2**20
"""A log is read from its end, so much at a time."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One line of the log."""

    time: str
    """UTC, as 2027-01-31T00:00:00Z."""
    who: str
    """Name of the token or certificate; empty: nobody that is known."""
    address: str
    """Where the request came from."""
    action: str
    """Method and path of a request, or what else happened."""
    status: int
    """HTTP status of the answer."""
    content: Mapping[str, Any]
    """The content of the request, without secrets."""


class AuditLog:
    """Lines that only the service appends."""

    def __init__(
        self, append: Callable[[bytes], object], lines: Callable[[int], list[bytes]], wall_clock: Callable[[], float]
    ) -> None:
        """``append`` appends a line; ``lines(limit)`` gives the newest ones, oldest first."""
        self._append, self._lines, self._wall_clock = append, lines, wall_clock
        self._refused, self._refused_from = 0, ""
        """Refused logins that have no line yet, and where the last one came from."""
        self._line_at = -math.inf

    def record(self, who: str, address: str, action: str, status: int, content: Mapping[str, Any]) -> None:
        """Append what somebody did. A disk that is full loses the line, which the service's own log then says."""
        at = datetime.fromtimestamp(self._wall_clock(), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        entry = AuditEntry(at, who, address, action, status, content)
        line = json.dumps(asdict(entry), separators=(",", ":")).encode()
        try:
            self._append(line)
        except OSError as error:
            _log.error("the audit log cannot be written (%s); lost: %s", error, line.decode())

    def refuse_login(self, address: str) -> None:
        """Count a request that no known token or certificate came with."""
        self._refused, self._refused_from = self._refused + 1, address
        if not self._line_at - REFUSED_EVERY_S <= self._wall_clock() < self._line_at:  # the clock may go back
            self.flush()

    def flush(self) -> None:
        """Write the refused logins that have no line yet."""
        if self._refused:
            self.record("", self._refused_from, "refused logins", 401, {"count": self._refused})
            self._refused, self._line_at = 0, self._wall_clock() + REFUSED_EVERY_S

    def newest(self, limit: int) -> list[AuditEntry]:
        """Up to ``limit`` newest entries, oldest first; a torn line is left out."""
        entries: list[AuditEntry] = []
        for line in self._lines(limit):
            with suppress(ValueError, TypeError):
                entries.append(AuditEntry(**json.loads(line)))
        return entries


def audit_file(path: Path, wall_clock: Callable[[], float] = time.time) -> AuditLog:
    """A log in a file that is written in one thread and may be read in any."""

    def append(line: bytes) -> None:
        with open(path, "a+b", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                line = line if file.read() == b"\n" else b"\n" + line  # a full disk tore the last one
            file.write(line + b"\n")

    def lines(limit: int) -> list[bytes]:
        if not path.exists():
            return []
        with path.open("rb") as file:
            begin, read = file.seek(0, os.SEEK_END), b""
            while begin and read.count(b"\n") <= limit:
                end, begin = begin, max(0, begin - READ_BYTES)
                file.seek(begin)
                read = file.read(end - begin) + read
        return read.splitlines()[-limit:]

    return AuditLog(append, lines, wall_clock)


def audit_table(server: Postgres, instance: str, writer: Executor) -> AuditLog:
    """A log in a table that all instances append to; the ``writer`` writes, so no request waits for the store."""

    def append(line: bytes) -> None:
        writer.submit(write, line.decode())

    def write(line: str) -> None:
        try:
            server.rows("INSERT INTO audit (instance, entry) VALUES (?, ?) RETURNING 1", (instance, line))
        except StoreError as error:
            _log.error("%s; lost: %s", error, line)

    def lines(limit: int) -> list[bytes]:
        rows = server.rows("SELECT entry FROM audit ORDER BY number DESC LIMIT ?", (limit,))
        return [entry.encode() for (entry,) in reversed(rows)]

    return AuditLog(append, lines, time.time)
