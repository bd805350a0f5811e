"""The state of an instance of the service that shares its store with others."""

import os
import signal
import socket
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from fcslam.cloud.settings import CloudConfig
from fcslam.cluster.workers import Workers
from fcslam.errors import ServiceError
from fcslam.service.audit_log import AuditLog
from fcslam.service.http.events import EventStreams
from fcslam.service.http.limits import RateLimit
from fcslam.service.http.state import ServiceState
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.shared.audit_table import AuditTable
from fcslam.service.shared.instance import Hooks
from fcslam.service.shared.mission_tables import Lease
from fcslam.service.shared.missions import Admission, SharedMissions
from fcslam.service.shared.registry import KnownMission
from fcslam.service.shared.schema import prepare
from fcslam.service.shared.spares import Spares
from fcslam.service.supervisor import RunningWorker, Supervisor
from fcslam.storage.postgres import Postgres, is_server, take_password

if TYPE_CHECKING:
    from fcslam.service.http.authentication import Authenticator


MAX_MISSIONS, MAX_ROBOTS = 20, 200
"""Workers that an instance runs, and robots that may send to it, unless the environment says more."""
LONGEST_HOST = 58
"""Characters of the host in an instance's name, which has 64 at most."""


def shared_state(
    store: str, port: int, data: Path, authenticator: "Authenticator", config: CloudConfig, workers: Workers
) -> ServiceState:
    """The state of an instance of the store; who closes its missions closes all that it holds.

    Host and port name the instance; FCSLAM_MAX_MISSIONS and FCSLAM_MAX_ROBOTS limit it.

    Raises:
        ServiceError: the store's address or a limit cannot be used.
        StoreError: the store cannot be used, or is of a newer version.
    """
    name = f"{socket.gethostname()[:LONGEST_HOST]}-{port}"
    admission = Admission(_limit("FCSLAM_MAX_MISSIONS", 0, MAX_MISSIONS), _limit("FCSLAM_MAX_ROBOTS", 1, MAX_ROBOTS))
    if not is_server(store):
        raise ServiceError("--store: not the address of a database; write postgresql://USER@HOST:PORT/DATABASE")
    url = take_password(store)
    with ExitStack() as opened:
        server = opened.enter_context(closing(Postgres(url, name)))
        prepare(server)
        spares = opened.enter_context(closing(Spares()))
        audit = opened.enter_context(closing(AuditTable(server, name)))

        def launch(mission: KnownMission, lease: Lease) -> RunningWorker:
            folder = MissionFolder(data / "missions" / mission.name)
            folder.path.mkdir(parents=True, exist_ok=True)
            options = ("--store", url, "--lease", str(lease.mission), str(lease.fence), *workers.options())
            return Supervisor(folder.path, time.monotonic, _ignore, options, spares.start)

        missions: SharedMissions
        events = EventStreams(lambda: missions.open_mission.name)
        hooks = Hooks(launch, events.publish, lambda: os.kill(os.getpid(), signal.SIGTERM))
        missions = SharedMissions(data, config, server, name, admission, hooks)
        log = AuditLog(audit, time.time)
        missions.closing = opened.pop_all().close
        return ServiceState(missions, authenticator, RateLimit(time.monotonic), events, log)


def _limit(variable: str, least: int, otherwise: int) -> int:
    """A limit that the environment gives.

    Raises:
        ServiceError: it is not a number, or too small.
    """
    text = os.environ.get(variable) or str(otherwise)
    if not (text.isdecimal() and int(text) >= least):
        raise ServiceError(f"{variable}={text}: is not a number from {least} on")
    return int(text)


def _ignore(event: str, number: int) -> None:
    """A worker's own events: those of all instances come from the store."""
