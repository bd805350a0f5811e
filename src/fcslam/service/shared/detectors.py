"""Detectors that every instance offers, whichever of them got the file."""

from pathlib import Path

from fcslam.records import Channel, DetectorFile
from fcslam.service.detectors import DetectorStore
from fcslam.storage.postgres import Postgres


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
