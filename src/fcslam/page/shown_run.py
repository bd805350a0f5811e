"""A run folder as viewers see it: finished, or written again and again while recordings are mapped."""

import threading
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.mission.mission_file import opened_copy
from fcslam.mission.mission_store import MissionStore
from fcslam.runs.folder import MISSION, identity, is_run_folder
from fcslam.service.intake import SessionState
from fcslam.service.viewed_mission import PacketCounts, viewed_run


class ShownRun:
    """A ``ViewedMission`` that nobody can change. Any thread may call; its end removes its copies of mission files."""

    def __init__(self, place: Path, name: str) -> None:
        """Show the run folder at ``place``, or the one that a link there names; there may be none yet."""
        self.name, self._place = name, place
        self._lock, self._copies = threading.Lock(), ExitStack()
        self._opened: dict[tuple[int, int] | None, tuple[MissionStore, Mapping[tuple[str, int], int]]] = {}
        """A copy of each mission file, and how many packets of each session, by robot and epoch, it holds; by the
        identity of the run folder. None: of all run folders without a mission file."""
        self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._copies.close()

    @property
    def run_folder(self) -> Path | None:
        """The run folder as it is now; None before the first one is written."""
        return self._place.resolve() if is_run_folder(self._place) else None

    @property
    def store(self) -> MissionStore:
        """The run folder's mission file; without packets if it has none."""
        return self._open()[0]

    def sessions(self, robot: str | None = None) -> list[SessionState]:
        """Sessions of one robot or of all, by robot and epoch."""
        folder, (_, packets) = self.run_folder, self._open()
        mapped = {} if folder is None else viewed_run(folder).trajectories
        known = sorted({*packets, *map(robot_and_epoch, mapped)})
        return [SessionState(*session, packets.get(session, 0)) for session in known if robot in (None, session[0])]

    def last_heard_s(self, robot: str) -> float | None:  # noqa: ARG002
        """None: no robot sends anything here."""
        return None

    def packet_counts(self) -> PacketCounts:
        """All packets of a finished run took effect."""
        count = sum(self._open()[1].values())
        return PacketCounts(count, count, 0)

    def _open(self) -> tuple[MissionStore, Mapping[tuple[str, int], int]]:
        """A copy of the mission file of the run folder as it is now."""
        folder = self.run_folder
        mission = folder / MISSION if folder is not None and (folder / MISSION).is_file() else None
        key = None if mission is None else identity(mission.parent)
        with self._lock:
            if key not in self._opened:
                store = self._copies.enter_context(opened_copy(mission))
                packets = Counter((envelope.robot, envelope.epoch) for envelope in store.envelopes())
                self._opened[key] = store, packets
            return self._opened[key]
