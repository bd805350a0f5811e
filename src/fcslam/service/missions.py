"""The missions of one service, of which one is open."""

import fcntl
import shutil
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import IO

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import InputError, StoreError
from fcslam.mission.mission_store import MissionStore
from fcslam.records import Change, Edit, Undo
from fcslam.runs.folder import is_run_folder
from fcslam.service.detectors import DetectorStore
from fcslam.service.intake import Agents, Intake, SessionState
from fcslam.service.joint_maps import ServedJointMaps
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.supervisor import RunningWorker
from fcslam.service.viewed_mission import PacketCounts
from fcslam.storage.database import translate_errors
from fcslam.storage.files import write_file

FIRST = "mission"
"""Name of a new service's first mission."""
IMPORT, EXPORT = ".import", ".export"
"""Prefixes of temporary folders of imported and exported missions."""


class UnknownMissionError(InputError):
    """There is no mission of this name."""

    def __init__(self, name: str, names: Iterable[str]) -> None:
        super().__init__(f"there is no mission '{name}'; there are {', '.join(names)}")


class OpenMission:
    """A mission with an intake and a worker. Viewers see it as a ``ViewedMission``."""

    def __init__(
        self,
        folder: MissionFolder,
        store: MissionStore,
        intake: Intake,
        worker: RunningWorker | None,
        wall_clock: Callable[[], float],
    ) -> None:
        self.folder, self.store, self.intake = folder, store, intake
        self._worker, self._wall_clock = worker, wall_clock
        self.served_maps = ServedJointMaps()

    @property
    def worker(self) -> RunningWorker:
        """The mission's worker as it is now."""
        assert self._worker is not None
        return self._worker

    @property
    def name(self) -> str:
        """Name of the mission."""
        return self.folder.name

    @property
    def agents(self) -> Agents:
        """Who speaks for each robot, and since when it is silent."""
        return self.intake.agents

    @property
    def run_folder(self) -> Path | None:
        """The live run folder as it is now; None: the worker has written none yet."""
        return self.folder.live.resolve() if self.folder.live.exists() else None

    @property
    def joint_maps(self) -> Path:
        """The file of the joint maps, which may not be there yet."""
        return self.folder.joint_maps

    def result(self, name: str) -> Path | None:
        """The run folder of a requested result; None if it does not exist."""
        return self.folder.result(name)

    def sessions(self, robot: str | None = None) -> list[SessionState]:
        """Sessions of one robot or of all, by robot and epoch, whoever received their packets."""
        self.intake.follow()
        return self.intake.sessions(robot)

    def packet_counts(self) -> PacketCounts:
        """How far the packets of all robots are."""
        self.intake.follow()
        counts = self.intake.ready_count(), self.store.applied(), self.intake.waiting_count()
        return PacketCounts(*counts, self.worker.is_ready)

    def edit(self, content: Change | Undo, author: str) -> Edit:
        """Append an edit to the mission's log; the worker follows it."""
        edit = self.store.edit(content, author, self._wall_clock())
        self.worker.notify()
        return edit

    def ask_to_finalize(self) -> int:
        """Request the result of all packets that arrived; returns the number of the request."""
        number = self.store.ask_to_finalize()
        self.worker.notify()
        return number

    def close(self) -> None:
        """Stop the worker, then close the store."""
        self.worker.stop()
        self.store.close()


def _check_file(folder: MissionFolder) -> None:
    """Refuse a mission whose file is gone: no new one takes its place."""
    if folder.worker_lock.exists() and not (folder.store.exists() and folder.store.stat().st_size):
        raise StoreError(
            f"{folder.store}: the mission's file is missing or empty; put its backup in its place, or move "
            f"{folder.path} away to begin a new mission"
        )


class Missions:
    """All missions below one folder, which this service locks; ``SharedMissions`` has the same methods."""

    def __init__(
        self,
        root: Path,
        config: CloudConfig,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        launch: Callable[[MissionFolder], RunningWorker],
    ) -> None:
        """Open the mission that was open last, or create the first one; ``launch`` starts the worker of a mission."""
        self.root = root
        self._config, self._clock, self._wall_clock, self._launch = config, clock, wall_clock, launch
        self._lock = locked(root)
        try:
            sweep(root)
            self.detectors = DetectorStore(root / "detectors")
            named = self._open_file.read_text(encoding="utf-8").strip() if self._open_file.exists() else FIRST
            self.open_mission = self._opened(named)
        except BaseException:
            self._lock.close()
            raise

    @property
    def names(self) -> list[str]:
        """All missions."""
        return sorted(path.parent.name for path in (self.root / "missions").glob("*/mission.sqlite"))

    def create(self, name: str) -> None:
        """Create a mission and open it."""
        if MissionFolder.of(self.root, name).store.exists():
            raise InputError(f"mission '{name}' exists; open it or choose another name")
        self._switch(name)

    def open(self, name: str) -> None:
        """Open a mission: robots' packets go to it from now on. The mission that was open is closed."""
        if not MissionFolder.of(self.root, name).store.exists():
            raise UnknownMissionError(name, self.names)
        self._switch(name)

    def result(self, name: str, number: int) -> Path | None:
        """The run folder of a result of a mission; None if it does not exist."""
        return MissionFolder.of(self.root, name).result(str(number))

    def export(self, name: str, path: Path) -> None:
        """Write a mission as one new file."""
        folder, mission = MissionFolder.of(self.root, name), self.open_mission
        if name == mission.name:
            mission.store.export(path)
            return
        if not folder.store.exists():
            raise UnknownMissionError(name, self.names)
        with closing(MissionStore(folder.store, is_checked=True)) as store:  # the export is checked
            store.export(path)

    def import_mission(self, name: str, path: Path) -> None:
        """Import a file below ``root`` that ``export`` wrote and ``check_mission`` passed, by moving it."""
        folder = MissionFolder.of(self.root, name)
        if folder.store.exists():
            raise InputError(f"mission '{name}' exists; choose another name")
        with translate_errors(folder.store):
            folder.path.mkdir(parents=True, exist_ok=True)
            path.replace(folder.store)

    def close(self) -> None:
        """Close the open mission and unlock the folder."""
        self.open_mission.close()
        self._lock.close()

    @property
    def _open_file(self) -> Path:
        return self.root / "open"

    def _switch(self, name: str) -> None:
        if name == self.open_mission.folder.name:
            return
        before = self.open_mission
        self.open_mission = self._opened(name)
        before.close()

    def _opened(self, name: str) -> OpenMission:
        folder = MissionFolder.of(self.root, name)
        with translate_errors(folder.path):
            folder.path.mkdir(parents=True, exist_ok=True)
        _check_file(folder)
        store = MissionStore(folder.store)
        try:
            fleet = store.configure(self._config).fleet
            intake = Intake(store, self._clock, self._wall_clock, self.detectors.announced, fleet)
        except BaseException:
            store.close()
            raise
        mission = OpenMission(folder, store, intake, self._launch(folder), self._wall_clock)
        try:
            with translate_errors(self._open_file):
                write_file(self._open_file, name + "\n")
        except BaseException:
            mission.close()
            raise
        return mission


def sweep(root: Path) -> None:
    """Remove unfinished files of a service that was killed; the folder is locked."""
    for path in (*root.glob(f"{IMPORT}*"), *root.glob(f"{EXPORT}*")):
        shutil.rmtree(path, ignore_errors=True)
    for path in root.glob("*/*/.*.partial"):
        path.unlink(missing_ok=True)


def locked(root: Path) -> IO[str]:
    """The folder's lock file, held until it is closed."""
    if is_run_folder(root):
        raise InputError(f"{root}: is a run, which `fcslam show {root}` shows; name a folder for missions")
    try:
        root.mkdir(parents=True, exist_ok=True)
        file = (root / "lock").open("w")
    except OSError as error:
        raise InputError(f"{root}: cannot keep missions there ({error}); name a folder to write in") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise InputError(f"{root}: another service uses this folder; stop it or name another folder") from error
    return file
