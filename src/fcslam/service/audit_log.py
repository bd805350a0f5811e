"""The audit log: who did what to the service, as lines of JSON that are only ever appended."""

import json
import logging
import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

REFUSED_EVERY_S = 60.0
"""Refused logins make one line in this time at most, so no client without a token can fill the disk."""
_READ_BYTES = 2**20
"""Bytes at the end of the log that ``newest`` reads."""

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


class AuditLog(ABC):
    """Lines that only the service appends."""

    def __init__(self, wall_clock: Callable[[], float]) -> None:
        self._wall_clock = wall_clock
        self._refused, self._refused_from = 0, ""
        """Refused logins that have no line yet, and where the last one came from."""
        self._line_at = -math.inf

    @abstractmethod
    def append(self, line: bytes) -> None:
        """Append a line."""

    @abstractmethod
    def lines(self, limit: int) -> list[bytes]:
        """At most ``limit`` newest lines, the oldest of them first."""

    def record(self, who: str, address: str, action: str, status: int, content: Mapping[str, Any]) -> None:
        """Append what somebody did. A disk that is full loses the line, which the service's own log then says."""
        at = datetime.fromtimestamp(self._wall_clock(), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        entry = AuditEntry(at, who, address, action, status, content)
        line = json.dumps(asdict(entry), separators=(",", ":")).encode()
        try:
            self.append(line)
        except OSError as error:
            _log.error("%s: cannot be written (%s); lost: %s", self, error, line.decode())

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
        """The entries of ``lines``."""
        return [AuditEntry(**json.loads(line)) for line in self.lines(limit)]


class AuditFile(AuditLog):
    """A file that is written in one thread and may be read in any."""

    def __init__(self, path: Path, wall_clock: Callable[[], float] = time.time) -> None:
        super().__init__(wall_clock)
        self._path = path

    def __str__(self) -> str:
        return str(self._path)

    def append(self, line: bytes) -> None:
        """As in ``AuditLog``."""
        file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            os.write(file, line + b"\n")
        finally:
            os.close(file)

    def lines(self, limit: int) -> list[bytes]:
        """As in ``AuditLog``."""
        try:
            with self._path.open("rb") as file:
                start = max(0, file.seek(0, os.SEEK_END) - _READ_BYTES)
                file.seek(start)
                return file.read().splitlines()[1 if start else 0 :][-limit:]
        except FileNotFoundError:
            return []
