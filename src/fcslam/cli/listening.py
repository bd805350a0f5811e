"""Ports on which commands listen, and their certificates."""

import os
import socket
from pathlib import Path
from typing import Annotated

import typer

from fcslam.errors import InputError


def listen(host: str, port: int) -> socket.socket:
    """Listen on an address; port 0 is a free one."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=512)
    except (OSError, UnicodeError) as error:
        raise InputError(f"cannot listen on {host}:{port} ({error}); choose another --port or --host") from error


Credentials = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        rich_help_panel="Credentials",
        help="Folder with the file of tokens, tokens.yaml, and for TLS cloud.pem and cloud.key; `fcslam tools "
        "certificates` makes one.",
    ),
]


def find_files(folder: Path | None) -> tuple[Path | None, Path | None, Path | None]:
    """Tokens, certificate and key in a service's folder of credentials, as far as they are there."""
    if folder is None:
        return None, None, None
    names = "tokens.yaml", "cloud.pem", "cloud.key"
    tokens, certificate, key = (folder / name if os.path.exists(folder / name) else None for name in names)
    if not (tokens or certificate or key):
        raise InputError(f"{folder}: holds neither tokens.yaml nor cloud.pem; `fcslam tools certificates` makes them")
    return tokens, certificate, key


def check_tls(certificate: Path | None, key: Path | None, client_ca: Path | None = None) -> None:
    """Check the certificate of a service and its key, and the authority of its clients' certificates."""
    import ssl

    from fcslam.wire.keys import no_passphrase

    if (certificate is None) != (key is None):
        raise InputError("--credentials: cloud.pem and cloud.key belong together; add the other one")
    if certificate is None or key is None:
        if client_ca is not None:
            raise InputError("--client-ca needs TLS; give --credentials with cloud.pem and cloud.key")
        return
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key, no_passphrase)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{certificate}, {key}: not a certificate with its key ({error})") from error
    if client_ca is None:
        return
    try:
        context.load_verify_locations(client_ca)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{client_ca}: no certificate authority can be read ({error})") from error
