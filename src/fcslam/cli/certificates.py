"""`fcslam certificates`: what a service with TLS needs, for development and for closed networks."""

from pathlib import Path
from typing import Annotated

import typer


def certificates(
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the credentials; what is there stays.")],
    host: Annotated[
        list[str] | None, typer.Option(help="Name or address by which the cloud is reached; may be given again.")
    ] = None,
    robot: Annotated[
        list[str] | None, typer.Option(help="A robot to make a token and a certificate for; may be given again.")
    ] = None,
    viewer: Annotated[list[str] | None, typer.Option(help="Somebody who may see everything.")] = None,
    admin: Annotated[list[str] | None, typer.Option(help="Somebody who may decide about missions.")] = None,
) -> None:
    """Make a certificate authority, certificates of the cloud and of robots, and tokens for robots and people."""
    import datetime

    from fcslam.cloud.sessions import check_robot
    from fcslam.errors import InputError, PacketError
    from fcslam.service.credentials import make_credentials
    from fcslam.service.http.authentication import Role
    from fcslam.wire.checks import check_name

    wanted = {Role.ROBOT: robot or [], Role.VIEWER: viewer or [], Role.ADMIN: admin or []}
    names = [(name, role) for role, given in wanted.items() for name in given]
    for name, role in names:
        if [other for other, _ in names].count(name) > 1:
            raise InputError(f"'{name}' is named twice; every token needs a name of its own")
        try:
            check_name(name, role)
            check_robot(name)
        except PacketError as error:
            raise InputError(str(error)) from error
    make_credentials(output, host or [], dict(names), datetime.datetime.now(datetime.UTC))
    typer.echo(f"authority, for all who connect: {output / 'ca.pem'}")
    typer.echo(f"for the cloud: {output / 'cloud.pem'}, {output / 'cloud.key'}, {output / 'tokens.yaml'}")
    for name, role in names:
        typer.echo(f"for {role} {name}: {output / 'tokens' / name}")
        if role is Role.ROBOT:
            stem = output / "robots" / name
            typer.echo(f"or, instead of the token, where the cloud is given --client-ca: {stem}.pem, {stem}.key")
