"""A finished run folder as viewers see it."""

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.mission.mission_file import opened_copy
from fcslam.runs.folder import MISSION
from fcslam.service.intake import SessionState
from fcslam.service.viewed_mission import PacketCounts, viewed_run


class ShownRun:
    """A ``ViewedMission`` that nobody can change. Any thread may call; its end removes its copy of the mission file."""

    def __init__(self, folder: Path) -> None:
        self.run_folder = folder.resolve()
        self.name = self.run_folder.name
        mission = folder / MISSION
        self._copy = ExitStack()
        self.store = self._copy.enter_context(opened_copy(mission if mission.is_file() else None))
        """The run folder's mission file; without packets if it has none."""
        self._packets = Counter((envelope.robot, envelope.epoch) for envelope in self.store.envelopes())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._copy.close()

    def sessions(self, robot: str | None = None) -> list[SessionState]:
        """Sessions of one robot or of all, by robot and epoch."""
        known = sorted({*self._packets, *map(robot_and_epoch, viewed_run(self.run_folder).trajectories)})
        return [SessionState(*session, self._packets[session]) for session in known if robot in (None, session[0])]

    def last_heard_s(self, robot: str) -> float | None:  # noqa: ARG002
        """None: no robot sends anything here."""
        return None

    def packet_counts(self) -> PacketCounts:
        """All packets of a finished run took effect."""
        count = self._packets.total()
        return PacketCounts(count, count, 0)
