"""The choice of the processes that verify closures."""

import re
from dataclasses import dataclass
from pathlib import Path

from fcslam.errors import InputError

MOST_PROCESSES = 256
_CLUSTER = re.compile(r"(tcp|tls)://[^/\s]+:\d{1,5}")


@dataclass(frozen=True, slots=True)
class Workers:
    """Which processes verify closures."""

    where: str = "1"
    """Number of processes, this one included, or the address of a Dask scheduler: tcp://HOST:PORT, tls://HOST:PORT."""
    ca: Path | None = None
    """Certificate of the authority that signed the certificates of the cluster (PEM); None: as Dask is configured."""
    certificate: Path | None = None
    """This process's certificate (PEM)."""
    key: Path | None = None
    """Private key of ``certificate`` (PEM)."""

    def check(self) -> None:
        """Check that this can be a choice.

        Raises:
            InputError: it cannot.
        """
        files = (self.ca, self.certificate, self.key)
        if any(files) and not all(files):
            raise InputError("--workers-ca, --workers-certificate and --workers-key belong together; give all or none")
        if any(files) and not self.where.startswith("tls://"):
            raise InputError("--workers-ca needs a cluster with TLS: --workers tls://HOST:PORT")
        missing = next((file for file in files if file is not None and not file.is_file()), None)
        if missing is not None:
            raise InputError(f"{missing}: there is no such file")
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
        if self == Workers():
            return []
        files = {"--workers-ca": self.ca, "--workers-certificate": self.certificate, "--workers-key": self.key}
        named = [text for option, file in files.items() if file is not None for text in (option, str(file.absolute()))]
        return ["--workers", self.where, *named]
