"""`fcslam serve`: the cloud as a service over HTTP."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.listening import Credentials, check_tls, find_files, listen
from fcslam.cli.options import ConfigFiles, Quiet, Space, WorkersOption, mission_config
from fcslam.cli.output import notices, print_line
from fcslam.cli.warm_up import EVERYTHING_S, report_uncached


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
            rich_help_panel="Credentials",
        ),
    ] = False,
    client_ca: Annotated[
        Path | None,
        typer.Option(
            help="Certificate of the authority that signs robots' certificates (PEM). Robots with such a certificate "
            "need no token.",
            rich_help_panel="Credentials",
        ),
    ] = None,
    config: ConfigFiles = None,
    in_space: Space = False,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            rich_help_panel="Learning",
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
            "share it (FCSLAM_MAX_MISSIONS limits this one). The default is a file for each mission in --data.",
            rich_help_panel="Several instances",
        ),
    ] = None,
    workers: WorkersOption = "1",
) -> None:
    """Receive packets of robots, map them, and serve map, trajectories and metrics; Ctrl-C stops the service."""
    import gc
    import logging

    from fcslam.cli import serving
    from fcslam.cluster.verifying import check_workers, is_cluster, verifying
    from fcslam.page.routes import page_router, report_router
    from fcslam.processes import keep_memory_trimmed
    from fcslam.service.authentication import Authenticator, read_tokens
    from fcslam.service.http.app import create_app
    from fcslam.service.shared.missions import NAMED
    from fcslam.storage.files import keep_private
    from fcslam.warmup import is_cold, warm_up_decoding

    tokens, certificate, key = find_files(credentials)
    check_tls(certificate, key, client_ca)
    if tokens is None and client_ca is None and not insecure:
        serving.check_open(host, credentials)
    check_workers(workers)
    if is_cluster(workers):
        with verifying(workers):  # refused here, not by the worker of each mission
            pass
    learning = serving.learning_settings(data, store) if learn else None
    keep_private()
    keep_memory_trimmed()
    logging.basicConfig(level=logging.WARNING if quiet else logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    with ExitStack() as stack, listen(host, port) as listening:
        known = read_tokens(tokens) if tokens is not None else None if client_ca is None else ()
        authenticator, given = Authenticator(known), mission_config(config, in_space=in_space).cloud
        if store is None:
            state = serving.own_state(data, authenticator, given, workers)
        else:
            state = serving.shared_state(store, listening.getsockname()[1], data, authenticator, given, workers)
        if (config or in_space) and state.mission.store.configure(given) != given:
            print_line(
                notices(), f"mission '{state.mission.name}' keeps its configuration; -c and --3d apply to new ones"
            )
        serving.reload_on_hangup(state, tokens)
        if not report_uncached(notices(quiet)) and is_cold():
            print_line(notices(quiet), f"compiling, first start only: about {EVERYTHING_S} s until maps are drawn")
        warm_up_decoding()
        gc.freeze()  # collecting these objects again and again would delay packets
        routers = [page_router(), report_router(state)]
        if learning is not None:
            from fcslam.learning.federated.relay import learning_router

            process = serving.learning_process(learning, state, data / "learning")
            routers.append(learning_router(state, stack.enter_context(process)))
        app = create_app(
            state,
            routers,
            only_local_names=tokens is None and client_ca is None,
            named=None if store is None else NAMED,
        )
        server = serving.make_server(app, certificate, key, client_ca, state.close)
        scheme, (address, number) = "https" if certificate else "http", listening.getsockname()[:2]
        shown = f"[{address}]" if ":" in address else address
        typer.echo(
            f"fcslam serves mission '{state.mission.folder.name}' at {scheme}://{shown}:{number}; Ctrl-C stops it"
        )
        server.run(sockets=[listening])
