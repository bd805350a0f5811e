"""Where a fleet finds its packets again when it replays them: in memory, or where they are stored anyway."""

from collections.abc import Callable
from typing import Protocol

from fcslam.cloud.sessions import robot_and_epoch


class Journal(Protocol):
    """Packets as they came, by session and number. A ``dict`` is one."""

    def __setitem__(self, number: tuple[str, int], data: bytes, /) -> None:
        """Keep a packet, in the place of one that was refused."""

    def __getitem__(self, number: tuple[str, int], /) -> bytes:
        """A packet that was kept."""


class StoredJournal:
    """Packets that are stored before they take effect: nothing of them stays in memory."""

    def __init__(self, read: Callable[[str, int, int], bytes]) -> None:
        """``read`` gives the packet of a robot, an epoch and a number."""
        self._read = read

    def __setitem__(self, number: tuple[str, int], data: bytes, /) -> None:
        """Nothing is left to do."""

    def __getitem__(self, number: tuple[str, int], /) -> bytes:
        """Read it where it is stored."""
        session, sequence = number
        return self._read(*robot_and_epoch(session), sequence)
