"""`fcslam setup tokens`: who may ask a service."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.examples import examples

app = typer.Typer(
    no_args_is_help=True,
    help="List, add, rotate and revoke tokens of a service.",
    epilog=examples("fcslam setup tokens list --tokens tokens.yaml"),
)

_FILE = typer.Option("--tokens", help="File of tokens, as `fcslam setup certificates` makes it.")
_OUTPUT = typer.Option("--output", "-o", help="File to write the token into, readable by you only.")
_EXPIRES = typer.Option(formats=["%Y-%m-%d"], help="Day (UTC) on which the token ends; without it, it never does.")
_RELOAD = "to make it count, send the service SIGHUP (systemctl reload fcslam-cloud)"

TokensFile = Annotated[Path, _FILE]
Name = Annotated[str, typer.Argument(help="Name of the robot or user.")]
Output = Annotated[Path, _OUTPUT]
Expires = Annotated[datetime | None, _EXPIRES]


@app.command("list", epilog=examples("fcslam setup tokens list --tokens tokens.yaml"))
def list_tokens(*, tokens: TokensFile) -> None:
    """Print name, role and end of every token, not the tokens, which nobody stores."""
    from fcslam.cli.output import answers, print_line
    from fcslam.service.http.authentication import read_tokens

    console = answers()
    for entry in read_tokens(tokens):
        ends = f"ends {entry.expires:%Y-%m-%d %H:%M} UTC" if entry.expires else "never ends"
        print_line(console, f"{entry.name}  {entry.role}  {ends}")


@app.command(epilog=examples("fcslam setup tokens add ben --role robot --tokens tokens.yaml -o ben"))
def add(
    name: Name,
    *,
    role: Annotated[str, typer.Option(help="robot, viewer or admin.")],
    tokens: TokensFile,
    output: Output,
    expires: Expires = None,
) -> None:
    """Make a token."""
    from fcslam.cloud.sessions import check_robot
    from fcslam.errors import InputError, PacketError
    from fcslam.service.http.authentication import Role
    from fcslam.service.token_file import TokenHolder, add_token
    from fcslam.wire.checks import check_name

    if role not in list(Role):
        raise InputError(f"--role {role}: a token's role is {', '.join(Role)}")
    try:
        check_name(name, role)
        check_robot(name)
    except PacketError as error:
        raise InputError(str(error)) from error
    with _writing():
        add_token(tokens, TokenHolder(name, Role(role), _end(expires)), output)
    typer.echo(f"{output}: the token of {role} {name}; {_RELOAD}", err=True)


@app.command(epilog=examples("fcslam setup tokens rotate boss --tokens tokens.yaml -o boss.token"))
def rotate(name: Name, *, tokens: TokensFile, output: Output, expires: Expires = None) -> None:
    """Replace a token by a new one."""
    from fcslam.service.token_file import rotate_token

    with _writing():
        rotate_token(tokens, name, _end(expires), output)
    typer.echo(f"{output}: the new token of {name}; {_RELOAD}", err=True)


@app.command(epilog=examples("fcslam setup tokens revoke robot3 --tokens tokens.yaml"))
def revoke(name: Name, *, tokens: TokensFile) -> None:
    """Remove a token."""
    from fcslam.service.token_file import revoke_token

    with _writing():
        revoke_token(tokens, name)
    typer.echo(f"{tokens}: without the token of {name}; {_RELOAD}", err=True)


def _end(day: datetime | None) -> datetime | None:
    return None if day is None else day.replace(tzinfo=UTC)


@contextmanager
def _writing() -> Iterator[None]:
    from fcslam.errors import OutputError

    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write the tokens ({error}); the file of tokens is as before") from error
