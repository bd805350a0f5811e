"""Files with which a robot shows who it is: tokens, and keys of TLS."""

import os
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fcslam.errors import InputError
from fcslam.records import StrPath

TOKEN, AUTHORITY, CERTIFICATE, KEY = "token", "ca.pem", "client.pem", "client.key"
"""Files in a robot's folder of credentials."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """What a robot shows a service, and how it knows the service."""

    token: str | None = field(default=None, repr=False)
    ca: StrPath | None = None
    """PEM file of the authority that signed the service's certificate; None: the authorities of this system."""
    own: tuple[StrPath, StrPath] | None = None
    """PEM files of the robot's certificate and its key, in place of a token."""


NO_CREDENTIALS: Final = Credentials()
"""For a service that asks for none."""


def read_credentials(folder: Path) -> Credentials:
    """The credentials in a robot's folder, as `fcslam tools certificates` writes it; each file may be missing."""
    there = {name for name in (TOKEN, AUTHORITY, CERTIFICATE, KEY) if os.path.exists(folder / name)}
    if not there:
        raise InputError(
            f"{folder}: holds no credentials ({TOKEN}, {AUTHORITY}, {CERTIFICATE} and {KEY}); give a folder in "
            "credentials/robots, which `fcslam tools certificates` makes"
        )
    if (CERTIFICATE in there) != (KEY in there):
        raise InputError(f"{folder}: {CERTIFICATE} and {KEY} belong together; add the other one, or remove this one")
    return Credentials(
        read_token(folder / TOKEN) if TOKEN in there else None,
        folder / AUTHORITY if AUTHORITY in there else None,
        (folder / CERTIFICATE, folder / KEY) if KEY in there else None,
    )


def no_passphrase() -> str:
    """Password callback for ``load_cert_chain``, so that OpenSSL does not ask on the terminal."""
    raise ssl.SSLError("the key is encrypted; give one without a passphrase: openssl pkey -in KEY -out KEY2")


def read_token(path: Path) -> str:
    """The token in a file."""
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no token can be read ({error}); give the file that `fcslam tools certificates` wrote"
        ) from error
    if not token or not token.isprintable() or " " in token:
        raise InputError(f"{path}: holds no token; it should be one word")
    return token
