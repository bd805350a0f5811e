"""The state of an instance of the service that shares its store with others."""

import os
import secrets
import signal
import socket
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from fcslam.cloud.settings import CloudConfig
from fcslam.cluster.workers import Workers
from fcslam.errors import PacketError, ServiceError
from fcslam.service.audit_log import AuditLog
from fcslam.service.http.events import EventStreams
from fcslam.service.http.limits import RateLimit
from fcslam.service.http.state import ServiceState
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.shared.audit_table import AuditTable
from fcslam.service.shared.mission_tables import Lease
from fcslam.service.shared.missions import Admission, SharedMissions
from fcslam.service.shared.registry import KnownMission
from fcslam.service.shared.schema import prepare
from fcslam.service.shared.spares import Spares
from fcslam.service.supervisor import RunningWorker, Supervisor
from fcslam.storage.postgres import Postgres, is_server, take_password
from fcslam.wire.checks import check_name

if TYPE_CHECKING:
    from fcslam.service.http.authentication import Authenticator


class Shared(NamedTuple):
    """The options of an instance."""

    store: str
    instance: str | None
    max_missions: int
    max_robots: int


def shared_state(
    shared: Shared, data: Path, authenticator: "Authenticator", config: CloudConfig, workers: Workers
) -> ServiceState:
    """The state of an instance; who closes its missions closes all that it holds.

    Raises:
        ServiceError: the store's address or the instance's name cannot be used.
        StoreError: the store cannot be used, or is of a newer version.
    """
    name = _name(shared.instance)
    if not is_server(shared.store):
        raise ServiceError("--store: this is not an address of a database; write postgresql://USER@HOST:PORT/DATABASE")
    url = take_password(shared.store)
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
        missions = SharedMissions(
            data, config, server, name, secrets.token_hex(8), Admission(shared.max_missions, shared.max_robots),
            time.monotonic, time.time, launch, events.publish, lambda: os.kill(os.getpid(), signal.SIGTERM),
        )  # fmt: skip
        log = AuditLog(audit, time.time)
        missions.closing = opened.pop_all().close
        return ServiceState(missions, authenticator, RateLimit(time.monotonic), events, log)


def _name(given: str | None) -> str:
    """The instance's name.

    Raises:
        ServiceError: it is not a name.
    """
    name = socket.gethostname() if given is None else given
    try:
        check_name(name, "--instance")
    except PacketError as error:
        raise ServiceError(str(error)) from error
    return name


def _ignore(event: str, number: int) -> None:
    """A worker's own events: those of all instances come from the store."""
