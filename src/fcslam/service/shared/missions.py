"""The missions of a store, as each of its instances serves all of them."""

import math
import secrets
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Final

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import InputError, StoreError
from fcslam.mission.mission_store import MissionStore
from fcslam.service.intake import AGENT_LEASE_S, Agents, Intake, held_by_another
from fcslam.service.mission_folder import MissionFolder, keep_newest
from fcslam.service.missions import FIRST, OpenMission, UnknownMissionError, locked, sweep
from fcslam.service.shared.files import JOINT, LIVE, RESULT, SharedDetectors, fetch_folder, fetched
from fcslam.service.shared.instance import LOOK_S, Instance
from fcslam.service.shared.mission_tables import Lease, MissionTables, insert_mission, schema_of
from fcslam.service.shared.registry import KnownMission, Registry
from fcslam.service.supervisor import Elsewhere, RunningWorker
from fcslam.storage.database import translate_errors
from fcslam.storage.files import write_file
from fcslam.storage.postgres import Postgres
from fcslam.wire.checks import check_name

NAMED: Final[ContextVar[str | None]] = ContextVar("named mission", default=None)
"""The mission that the present request names; None: the open one."""
_SEEN: Final = "seen"
"""Folder of a mission's run folders that its workers, here or elsewhere, shared."""


class SharedAgents(Agents):
    """The agents of one mission's robots, known to all instances, which ask the store now and then."""

    def __init__(self, server: Postgres, mission: int, clock: Callable[[], float]) -> None:
        super().__init__(clock)
        self._server, self._schema = server, schema_of(mission)
        self._confirmed: dict[str, tuple[str, float]] = {}
        """By robot, the agent that the store named last, and when."""

    def hold(self, robot: str, agent: str) -> None:
        """Let an agent speak for a robot."""
        now, (known, asked) = self._clock(), self._confirmed.get(robot, ("", 0.0))
        if known != agent or now >= asked + AGENT_LEASE_S / 3.0:
            taken = self._server.rows(
                "INSERT INTO agents VALUES (?, ?, clock_timestamp()) ON CONFLICT (robot) DO UPDATE"
                " SET agent = excluded.agent, heard = clock_timestamp() WHERE agents.agent = excluded.agent"
                f" OR agents.heard < clock_timestamp() - interval '{AGENT_LEASE_S} seconds' RETURNING 1",
                (robot, agent),
                self._schema,
            )
            if not taken:
                raise held_by_another(robot, AGENT_LEASE_S)
            self._confirmed[robot] = agent, now
        self.note(robot, agent)

    def end(self, robot: str) -> None:
        """Note that a robot ended: any agent may speak for it now, to every instance."""
        super().end(robot)
        self._confirmed.pop(robot, None)
        self._server.rows("DELETE FROM agents WHERE robot = ? RETURNING 1", (robot,), self._schema)

    def silent_s(self, robot: str) -> float | None:
        """Seconds since the robot's last batch to this instance, or about that to another one; None: never."""
        here = super().silent_s(robot)
        rows = self._server.rows(
            "SELECT CAST(extract(epoch FROM clock_timestamp() - heard) AS DOUBLE PRECISION) FROM agents"
            " WHERE robot = ?",
            (robot,),
            self._schema,
        )
        known = [silent for silent in (here, *(float(silent) for (silent,) in rows)) if silent is not None]
        return min(known, default=None)


class SharedMission(OpenMission):
    """A mission whose worker may be on any instance."""

    def __init__(
        self,
        number: int,
        folder: MissionFolder,
        server: Postgres,
        store: MissionStore,
        intake: Intake,
        instance: Instance,
    ) -> None:
        self._number, self._server, self._instance = number, server, instance
        self._fetching = threading.Lock()
        self._joint_at_s = -math.inf
        super().__init__(folder, store, intake, None, time.time)

    @property
    def worker(self) -> RunningWorker:
        """As in ``OpenMission``; it may be on another instance."""
        here = self._instance.worker(self._number)
        if here is not None:
            return here
        known = self._instance.known.get(self.name)
        is_ready = known is not None and known.is_held and known.is_ready
        return Elsewhere(is_ready, self.store.applied())

    @property
    def run_folder(self) -> Path | None:
        """The newest live run folder that a worker shared; None before the first one."""
        known = self._instance.known.get(self.name)
        return None if known is None or not known.live else self._fetched(LIVE, LIVE, str(known.live))

    @property
    def joint_maps(self) -> Path:
        """The file of the joint maps: that of the worker here, or a copy of what the worker elsewhere shared."""
        if self._instance.worker(self._number) is not None:
            return super().joint_maps
        copy = self.folder.path / _SEEN / JOINT
        with self._fetching:
            now_s = time.monotonic()
            if now_s > self._joint_at_s:
                content, self._joint_at_s = fetched(self._server, self._number, JOINT), now_s + LOOK_S
                if content is not None:
                    with translate_errors(copy):
                        copy.parent.mkdir(parents=True, exist_ok=True)
                        write_file(copy, content)
        return copy

    def result(self, name: str) -> Path | None:
        """As in ``OpenMission``."""
        return self._fetched(f"{RESULT}{name}", "runs", name)

    def close(self) -> None:
        """Nothing: the instance stops its worker."""

    def _fetched(self, name: str, kind: str, number: str) -> Path | None:
        """A shared run folder, which is fetched once."""
        path = self.folder.path / _SEEN / kind / number
        with self._fetching:
            if path.is_dir():
                return path
            if not fetch_folder(self._server, self._number, name, path):
                return None
            keep_newest(path.parent)
        return path


class SharedMissions:
    """All missions of a store; ``Missions`` of files has the same methods."""

    def __init__(
        self,
        root: Path,
        config: CloudConfig,
        server: Postgres,
        name: str,
        most_missions: int,
        launch: Callable[[KnownMission, Lease], RunningWorker],
        listen: Callable[[str, int, str], None],
        resources: ExitStack,
    ) -> None:
        """Take the instance's name, and create the first mission if the server has no mission.

        Files in ``root`` are this instance's own, and can be made again from the store. ``resources`` are closed at
        the end, from now on here. The other arguments are those of an ``Instance``.
        """
        self.root = root
        self._config, self._server = config, server
        resources.enter_context(locked(root))
        sweep(root)
        for seen in root.glob(f"missions/*/{_SEEN}"):
            shutil.rmtree(seen, ignore_errors=True)
        self.detectors = SharedDetectors(root / "detectors", server)
        self._registry = Registry(server, name, secrets.token_hex(8))
        self._opening = threading.Lock()
        self._opened: dict[str, SharedMission] = {}
        self.detectors.follow()
        self._instance = Instance(self._registry, name, most_missions, launch, listen, self.detectors.follow)
        resources.callback(self._instance.close)
        if not any(known.is_open for known in self._instance.known.values()):
            self._open_first()
        self._instance.start()
        self._resources = resources.pop_all()

    @property
    def names(self) -> list[str]:
        """All missions."""
        self._instance.look()
        return sorted(self._instance.known)

    @property
    def open_name(self) -> str:
        """Name of the mission that the present request names, or else of the open one; asks no store."""
        known = self._instance.known
        return NAMED.get() or next((name for name, mission in known.items() if mission.is_open), FIRST)

    @property
    def open_mission(self) -> SharedMission:
        """The mission of the ``open_name``."""
        name = self.open_name
        return self._opened.get(name) or self._open_here(name)

    def create(self, name: str) -> None:
        """As in ``Missions``."""
        check_name(name, "mission")
        number = self._registry.create(name)
        MissionStore(MissionTables(self._server, number)).configure(self._config)
        self.open(name)

    def open(self, name: str) -> None:
        """Let robots that name no mission send to this one; raises as in ``Missions``."""
        self._registry.open(self._known(name).number)
        self._instance.look()

    def result(self, name: str, number: int) -> Path | None:
        """As in ``Missions``."""
        return self._open_here(name).result(str(number))

    def export(self, name: str, path: Path) -> None:
        """As in ``Missions``."""
        MissionTables(self._server, self._known(name).number).export(path)

    def import_mission(self, name: str, path: Path) -> None:
        """As in ``Missions``."""
        check_name(name, "mission")
        self._registry.create(name, partial(insert_mission, path))
        self._instance.look()

    def close(self) -> None:
        """Give up all missions, for other instances to take, unlock the folder, and close the resources."""
        self._resources.close()

    def _open_first(self) -> None:
        try:
            self.create(FIRST)
        except StoreError:
            raise
        except InputError:  # it is there, perhaps from another instance a moment ago
            self.open(FIRST)

    def _known(self, name: str) -> KnownMission:
        if name not in self._instance.known:
            self._instance.look()
        known = self._instance.known.get(name)
        if known is None:
            raise UnknownMissionError(name, self._instance.known)
        return known

    def _open_here(self, name: str) -> SharedMission:
        known, folder = self._known(name), MissionFolder.of(self.root, name)
        with self._opening:
            if name not in self._opened:
                with translate_errors(folder.path):
                    folder.path.mkdir(parents=True, exist_ok=True)
                store = MissionStore(MissionTables(self._server, known.number))
                fleet = store.configure(self._config).fleet
                agents = SharedAgents(self._server, known.number, time.monotonic)
                intake = Intake(store, time.monotonic, time.time, self.detectors.announced, fleet, agents)
                self._opened[name] = SharedMission(known.number, folder, self._server, store, intake, self._instance)
            return self._opened[name]
