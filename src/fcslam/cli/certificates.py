"""`fcslam tools certificates`: credentials for a service with TLS, for development and closed networks."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.errors import InputError, PacketError


def certificates(
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the credentials. Existing ones are kept.")
    ] = Path("credentials"),
    host: Annotated[
        list[str] | None, typer.Option(help="Host name or IP address of the service. Can be repeated.")
    ] = None,
    robot: Annotated[
        list[str] | None, typer.Option(help="Name of a robot, which gets a token and a certificate. Can be repeated.")
    ] = None,
    viewer: Annotated[
        list[str] | None, typer.Option(help="Name of a user who may read everything. Can be repeated.")
    ] = None,
    admin: Annotated[
        list[str] | None, typer.Option(help="Name of a user who may also manage missions. Can be repeated.")
    ] = None,
    cluster: Annotated[
        bool,
        typer.Option(
            "--cluster", help="Also make an authority and a certificate for a Dask cluster, see `fcslam map --workers`."
        ),
    ] = False,
) -> None:
    """Make a certificate authority, certificates of the service and of robots, and tokens for robots and users."""
    import datetime

    from fcslam.cloud.sessions import check_robot
    from fcslam.service.credentials import folder_of, make_cluster_credentials, make_credentials
    from fcslam.service.http.authentication import Role
    from fcslam.wire.checks import check_name

    wanted = {Role.ROBOT: robot or [], Role.VIEWER: viewer or [], Role.ADMIN: admin or []}
    names = [(name, role) for role, given in wanted.items() for name in given]
    for name, role in names:
        if [other for other, _ in names].count(name) > 1:
            raise InputError(f"'{name}' is named twice; every token needs another name")
        try:
            check_name(name, role)
            check_robot(name)
        except PacketError as error:
            raise InputError(str(error)) from error
    now = datetime.datetime.now(datetime.UTC)
    make_credentials(output, host or [], dict(names), now)
    if cluster:
        make_cluster_credentials(output, now)
    typer.echo(f"authority, for all clients: {output / 'ca.pem'}")
    typer.echo(f"for the service: {output / 'cloud.pem'}, {output / 'cloud.key'}, {output / 'tokens.yaml'}")
    for name, role in names:
        typer.echo(f"for {role} {name}: {folder_of(output, name, role)}")
    if cluster:
        stem = output / "cluster"
        typer.echo(f"for a cluster, robots excepted: {stem / 'ca.pem'}, {stem / 'member.pem'}, {stem / 'member.key'}")
