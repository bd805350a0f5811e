"""What `fcslam serve` puts together: the state of a service or of one of its instances, its server, and learning."""

import logging
import os
import signal
import socket
import ssl
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import typer
import uvicorn
from fastapi import FastAPI

from fcslam.cli.training_options import LEARNING_FILE, require_training_libraries
from fcslam.cloud.settings import CloudConfig
from fcslam.config import load
from fcslam.errors import FcslamError, InputError
from fcslam.learning.federated.settings import RELEASE, FleetLearningSettings
from fcslam.learning.settings import DETECTOR
from fcslam.processes import Child, module_command
from fcslam.service.audit_log import audit_file, audit_table
from fcslam.service.authentication import Authenticator, read_tokens
from fcslam.service.http.protocol import GuardedProtocol, GuardedServer, allow_many_connections
from fcslam.service.http.state import EventStream, ServiceState
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.missions import Missions
from fcslam.service.shared.mission_tables import Lease, prepare
from fcslam.service.shared.missions import SharedMissions
from fcslam.service.shared.registry import KnownMission
from fcslam.service.supervisor import RunningWorker, StandbyWorkers, Supervisor, WorkerTask, start_worker
from fcslam.storage.postgres import Postgres, take_password
from fcslam.wire.http_transport import is_loopback

_log = logging.getLogger("fcslam.service")


def check_open(host: str, credentials: Path | None) -> None:
    """Check that a service may go without authentication."""
    if not is_loopback(host):
        raise InputError(f"everybody who reaches {host} could send and read; give --credentials, or --insecure")
    if credentials is not None:
        raise InputError(
            f"{credentials}: holds no tokens.yaml, so everybody could send and read; `fcslam tools certificates` adds "
            "it; or give --client-ca or --insecure"
        )


def own_state(data: Path, authenticator: Authenticator, config: CloudConfig, workers: str) -> ServiceState:
    """The state of a service whose missions are files in the folder ``data``."""
    events = EventStream()

    def launch(folder: MissionFolder) -> RunningWorker:
        task = WorkerTask(str(folder.path), workers)
        return Supervisor(folder.name, lambda: start_worker(task), events.publish)

    missions = Missions(data, config, time.monotonic, time.time, launch)
    return ServiceState(missions, authenticator, events, audit_file(data / "audit.jsonl"), data / "learning")


def shared_state(
    store: str, port: int, data: Path, authenticator: Authenticator, config: CloudConfig, workers: str
) -> ServiceState:
    """The state of an instance of the store; who closes its missions closes all that it holds.

    Host and port name the instance; FCSLAM_MAX_MISSIONS limits it.
    """
    name, limit = f"{socket.gethostname()[:58]}-{port}", os.environ.get("FCSLAM_MAX_MISSIONS") or "20"
    if not limit.isdecimal():
        raise InputError(f"FCSLAM_MAX_MISSIONS={limit}: is not a number from 0 on")
    if not store.startswith(("postgresql://", "postgres://")):
        raise InputError("--store: not the address of a database; write postgresql://USER@HOST:PORT/DATABASE")
    url = take_password(store)
    with ExitStack() as opened:
        server = opened.enter_context(closing(Postgres(url, name)))
        prepare(server)
        standby = opened.enter_context(closing(StandbyWorkers()))
        audit = audit_table(server, name, opened.enter_context(ThreadPoolExecutor(1, "audit log")))

        def launch(mission: KnownMission, lease: Lease) -> RunningWorker:
            folder = MissionFolder(data / "missions" / mission.name)
            folder.path.mkdir(parents=True, exist_ok=True)
            task = WorkerTask(str(folder.path), workers, url, lease)
            # Events of all instances, this one included, come from the store.
            return Supervisor(folder.name, lambda: standby.start(task), lambda *_: None)

        missions: SharedMissions
        events = EventStream(lambda: missions.open_name)
        missions = SharedMissions(data, config, server, name, int(limit), launch, events.publish, opened)
        return ServiceState(missions, authenticator, events, audit)


def reload_on_hangup(state: ServiceState, tokens: Path | None) -> None:
    """Read the tokens again at SIGHUP; keep the previous ones if the file is bad."""

    def reload(*_: object) -> None:
        if tokens is None:
            return
        try:
            changed = state.authenticator.replace(read_tokens(tokens))
        except FcslamError as error:
            _log.error("%s; keeping the previous tokens", error)
        else:
            _log.warning("read the tokens of %s again", tokens)
            state.audit.record("", "", "tokens read again", 200, {"changed": changed})

    signal.signal(signal.SIGHUP, reload)


def make_server(
    app: FastAPI, certificate: Path | None, key: Path | None, client_ca: Path | None, on_exit: Callable[[], None]
) -> uvicorn.Server:
    """The server of an application; ``on_exit`` is called when it is asked to stop."""
    allow_many_connections()
    return GuardedServer(
        uvicorn.Config(
            app,
            http=GuardedProtocol,
            ssl_certfile=certificate,
            ssl_keyfile=key,
            ssl_ca_certs=None if client_ca is None else str(client_ca),
            ssl_cert_reqs=ssl.CERT_NONE if client_ca is None else ssl.CERT_OPTIONAL,
            backlog=512,
            log_level="error",  # a line for each request that is no HTTP would fill the disk
            proxy_headers="FORWARDED_ALLOW_IPS" in os.environ,  # else any program of this machine names the client
            ws="none",
            server_header=False,
            timeout_graceful_shutdown=10,
            h11_max_incomplete_event_size=64 * 1024,
        ),
        on_exit,
    )


def learning_settings(data: Path, store: str | None) -> FleetLearningSettings:
    """Check all that learning needs, before anything starts; the folder ``data`` may hold a file of settings."""
    if store is not None:
        raise InputError("--learn works with missions in --data; leave out --store")
    config = data / LEARNING_FILE
    settings = load(FleetLearningSettings, config) if config.exists() else FleetLearningSettings()
    require_training_libraries()
    return settings


@contextmanager
def learning_process(settings: FleetLearningSettings, state: ServiceState, output: Path) -> Iterator[Path]:
    """Run the process in which the fleet learns beside the block; robots get what it releases.

    Gives the Unix socket of the process, in a folder that only this user can open. Its rounds are in ``output``.
    """

    def announce(event: str, _content: object) -> None:
        if event != RELEASE:
            return
        try:
            file = state.missions.detectors.announce((output / DETECTOR).read_bytes())
        except (FcslamError, OSError) as error:
            _log.error("a release of learning cannot be announced: %s", error)
        else:
            _log.warning("robots are to use detector %s from now on", file.version)

    with tempfile.TemporaryDirectory(prefix="fcslam-") as folder:
        listener = Path(folder) / "learning"
        data, chosen = str(state.missions.root), settings.model_dump_json()
        options = ["--listener", str(listener), "--settings", chosen, "--output", str(output)]
        command = module_command("fcslam.learning.federated.fleet_learning", *options, data)
        learner = Supervisor("learning", lambda: Child(command), announce)
        typer.echo(f"robots learn here; rounds are in {output}")
        try:
            yield listener
        finally:
            learner.stop()
