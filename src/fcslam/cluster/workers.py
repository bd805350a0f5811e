"""The choice of the processes that verify closures."""

import re
from dataclasses import dataclass

from fcslam.errors import InputError

MOST_PROCESSES = 256
_CLUSTER = re.compile(r"(tcp|tls)://[^/\s]+:\d{1,5}")


@dataclass(frozen=True, slots=True)
class Workers:
    """Which processes verify closures."""

    where: str = "1"
    """Number of processes, this one included, or the address of a Dask scheduler: tcp://HOST:PORT, tls://HOST:PORT."""

    def check(self) -> None:
        """Check that this can be a choice.

        Raises:
            InputError: it cannot.
        """
        if self.is_cluster or (self.where.isdecimal() and 1 <= int(self.where) <= MOST_PROCESSES):
            return
        raise InputError(
            f"--workers: '{self.where}' is neither a number from 1 to {MOST_PROCESSES} nor the address of a Dask "
            "scheduler, tcp://HOST:PORT or tls://HOST:PORT"
        )

    @property
    def is_cluster(self) -> bool:
        """Whether it names a cluster."""
        return _CLUSTER.fullmatch(self.where) is not None

    def options(self) -> list[str]:
        """The options of a command that make the same choice."""
        return [] if self == Workers() else ["--workers", self.where]
