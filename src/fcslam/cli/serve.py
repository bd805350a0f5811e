"""`fcslam serve`: the cloud as a service over HTTP."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.listening import Credentials, check_tls, find_files, listen
from fcslam.cli.mission_options import ConfigFiles, mission_config
from fcslam.cli.options import Quiet, WorkersOption
from fcslam.cli.output import notices
from fcslam.cli.warm_up import tell_uncached
from fcslam.errors import FcslamError, ServiceError

if TYPE_CHECKING:
    from collections.abc import Callable

    import uvicorn
    from fastapi import FastAPI

    from fcslam.cloud.settings import CloudConfig
    from fcslam.cluster.workers import Workers
    from fcslam.service.http.authentication import Authenticator
    from fcslam.service.http.state import ServiceState

_CREDENTIALS = "Credentials"
_INSTANCES = "Several instances"
_LEARNING = "Learning"


def serve(
    *,
    data: Annotated[Path, typer.Option("--data", help="Folder of the missions, created if it does not exist.")],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 chooses a free one.")] = 8340,
    credentials: Credentials = None,
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure",
            help="Accept requests from other machines without authentication.",
            rich_help_panel=_CREDENTIALS,
        ),
    ] = False,
    client_ca: Annotated[
        Path | None,
        typer.Option(
            help="Certificate of the authority that signs robots' certificates (PEM). Robots with such a certificate "
            "need no token.",
            rich_help_panel=_CREDENTIALS,
        ),
    ] = None,
    config: ConfigFiles = None,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            rich_help_panel=_LEARNING,
            help="Let the robots train the detector together while they map, on what they see again. Settings: "
            "learning.yaml in --data.",
        ),
    ] = False,
    quiet: Quiet = False,
    store: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="PostgreSQL database for all missions, postgresql://USER@HOST:PORT/DATABASE; several instances may "
            "share it (FCSLAM_MAX_MISSIONS and FCSLAM_MAX_ROBOTS limit this one). The default is a file for "
            "each mission in --data.",
            rich_help_panel=_INSTANCES,
        ),
    ] = None,
    workers: WorkersOption = "1",
) -> None:
    """Receive packets of robots, map them, and serve map, trajectories and metrics; Ctrl-C stops the service."""
    import gc
    import logging

    from fcslam.cli.serve_learning import learning_plan, learning_process
    from fcslam.cli.shared_service import shared_state
    from fcslam.cluster.verifying import verifying
    from fcslam.cluster.workers import Workers
    from fcslam.page.routes import page_router, report_router
    from fcslam.processes import keep_memory_trimmed
    from fcslam.service.http.app import create_app
    from fcslam.service.shared.missions import NAMED
    from fcslam.service.warmup import warm_up_decoding
    from fcslam.storage.files import keep_private

    tokens, certificate, key = find_files(credentials)
    check_tls(certificate, key, client_ca)
    if tokens is None and client_ca is None and not insecure:
        _check_open(host, credentials)
    chosen = Workers(workers)
    chosen.check()
    if chosen.is_cluster:
        with verifying(chosen):  # refused here, not by the worker of each mission
            pass
    plan = learning_plan(learn, data, store)
    keep_private()
    keep_memory_trimmed()
    logging.basicConfig(level=logging.WARNING if quiet else logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    with ExitStack() as stack, listen(host, port) as listening:
        authenticator, given = _authenticator(tokens, client_ca), mission_config(config).cloud
        if store is None:
            state = _state(data, authenticator, given, chosen)
        else:
            state = shared_state(store, listening.getsockname()[1], data, authenticator, given, chosen)
        _reload_on_hangup(state, tokens)
        tell_uncached(notices(quiet))
        warm_up_decoding()
        gc.freeze()  # collecting these objects again and again would delay packets
        routers = [page_router(), report_router(state)]
        if plan is not None:
            from fcslam.learning.federated.relay import learning_router

            routers.append(learning_router(state, stack.enter_context(learning_process(plan, state))))
        app = create_app(
            state, routers, local_names=tokens is None and client_ca is None, named=None if store is None else NAMED
        )
        server = _server(app, certificate, key, client_ca, state.close)
        scheme, (address, number) = "https" if certificate else "http", listening.getsockname()[:2]
        shown = f"[{address}]" if ":" in address else address
        typer.echo(
            f"fcslam serves mission '{state.mission.folder.name}' at {scheme}://{shown}:{number}; Ctrl-C stops it"
        )
        server.run(sockets=[listening])


def _check_open(host: str, credentials: Path | None) -> None:
    """Check that a service may go without authentication.

    Raises:
        ServiceError: others reach it, or credentials are given in vain.
    """
    from fcslam.wire.http_transport import is_loopback

    if not is_loopback(host):
        raise ServiceError(f"everybody who reaches {host} could send and read; give --credentials, or --insecure")
    if credentials is not None:
        raise ServiceError(
            f"{credentials}: holds no tokens.yaml, so everybody could send and read; `fcslam tools certificates` adds "
            "it; or give --client-ca or --insecure"
        )


def _server(
    app: "FastAPI", certificate: Path | None, key: Path | None, client_ca: Path | None, on_exit: "Callable[[], None]"
) -> "uvicorn.Server":
    import os
    import ssl

    import uvicorn

    from fcslam.service.http.protocol import GuardedProtocol, GuardedServer, allow_many_connections

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


def _authenticator(tokens: Path | None, client_ca: Path | None) -> "Authenticator":
    from fcslam.service.http.authentication import Authenticator, read_tokens

    if tokens is None:
        return Authenticator(None if client_ca is None else ())
    return Authenticator(read_tokens(tokens))


def _reload_on_hangup(state: "ServiceState", tokens: Path | None) -> None:
    """Read the tokens again at SIGHUP; keep the previous ones if the file is bad."""
    import logging
    import signal

    from fcslam.service.http.authentication import read_tokens

    log = logging.getLogger("fcslam.service")

    def reload(*_: object) -> None:
        if tokens is None:
            return
        try:
            changed = state.authenticator.replace(read_tokens(tokens))
        except FcslamError as error:
            log.error("%s; keeping the previous tokens", error)
        else:
            log.warning("read the tokens of %s again", tokens)
            state.audit.record("", "", "tokens read again", 200, {"changed": changed})

    signal.signal(signal.SIGHUP, reload)


def _state(data: Path, authenticator: "Authenticator", config: "CloudConfig", workers: "Workers") -> "ServiceState":
    import sys
    import time

    from fcslam.service.audit_log import AuditFile, AuditLog
    from fcslam.service.http.events import EventStream
    from fcslam.service.http.limits import RateLimit
    from fcslam.service.http.state import ServiceState
    from fcslam.service.missions import Missions
    from fcslam.service.supervisor import Supervisor

    events = EventStream()
    command = (sys.executable, "-m", "fcslam.service.worker", *workers.options())
    missions = Missions(
        data,
        config,
        time.monotonic,
        time.time,
        lambda folder: Supervisor(folder.path, time.monotonic, events.publish, command),
    )
    audit = AuditLog(AuditFile(data / "audit.jsonl"), time.time)
    return ServiceState(missions, authenticator, RateLimit(time.monotonic), events, audit, data / "learning")
