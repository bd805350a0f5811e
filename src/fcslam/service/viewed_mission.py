"""A mission as viewers see it. A live mission and a finished run have the same form, so one page shows both."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from fcslam.cloud.report import TURNS
from fcslam.cloud.sessions import session_name
from fcslam.mission.mission_store import MissionStore
from fcslam.runs import Run, open_run
from fcslam.runs.folder import identity
from fcslam.service.intake import Agents, SessionState


class PacketCounts(NamedTuple):
    """How far the packets of a mission are."""

    arrived: int
    """With all those before them in their sessions."""
    applied: int
    """That took effect."""
    waiting: int
    """That wait for an earlier one."""
    worker_ready: bool = True
    """Whether the mission's worker can apply packets now."""


class MapLag(NamedTuple):
    """What the drawn map lacks of what arrived."""

    packets: int
    sessions: int
    """That are in no map yet."""
    s: float
    """Since the oldest of the packets arrived."""


class ViewedMission(Protocol):
    """A mission as viewers see it. Any thread may call; nothing here changes the mission."""

    @property
    def name(self) -> str:
        """Name of the mission or of the run folder."""

    @property
    def run_folder(self) -> Path | None:
        """The newest run folder; its files never change, but another one may replace it. None before the first."""

    @property
    def store(self) -> MissionStore:
        """Packets, edits and corrections, for reading."""

    @property
    def agents(self) -> Agents:
        """Who speaks for each robot, and since when it is silent."""

    def sessions(self, robot: str | None = None) -> list[SessionState]:
        """Sessions of one robot or of all, by robot and epoch."""

    def packet_counts(self) -> PacketCounts:
        """How far the packets of all robots are."""


def run_of(mission: ViewedMission) -> Run:
    """The newest run, without its maps; an empty one before the first one is written."""
    folder = mission.run_folder
    return Run({}) if folder is None else viewed_run(folder)


def map_lag(mission: ViewedMission, now_s: float) -> MapLag:
    """What the live map of an open mission lacks; ``now_s``: seconds since 1970."""
    run, arrived = run_of(mission), mission.packet_counts().arrived
    packets = arrived - round(run.metrics[TURNS].value) if TURNS in run.metrics else arrived
    if packets <= 0:
        return MapLag(0, 0, 0.0)
    sessions = {session_name(session.robot, session.epoch) for session in mission.sessions()}
    return MapLag(packets, len(sessions - run.trajectories.keys()), now_s - mission.store.received_s(packets))


_reading: dict[Path, threading.Lock] = {}
"""Many robots and pages ask at once: one request reads a run of a mission, the others about the mission wait for it."""
_kept: dict[Path, tuple[object, Run]] = {}
"""The newest run of each mission, by the folder of its run folders. The one that was asked for last is the last."""


def viewed_run(folder: Path, read: Callable[..., Run] = open_run) -> Run:
    """The run in a ``run_folder`` of a viewed mission, without its large files."""
    mission = folder.parent
    with _reading.setdefault(mission, threading.Lock()):
        key = folder, identity(folder) if folder.exists() else None
        known, run = _kept.pop(mission, (None, None))
        if run is None or known != key:
            run = read(folder, maps=False)
        _kept[mission] = key, run
        for old in list(_kept)[:-4]:
            _kept.pop(old, None)
        return run
