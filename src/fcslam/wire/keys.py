"""A cloud as a robot knows it, and the files with which the robot shows who it is: tokens, and keys of TLS."""

import os
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from fcslam.errors import InputError
from fcslam.records import StrPath

TOKEN, AUTHORITY, CERTIFICATE, KEY = "token", "ca.pem", "client.pem", "client.key"
"""Files in a robot's folder of credentials."""


@dataclass(frozen=True, slots=True)
class Server:
    """Address of a cloud, the robot's credentials, and the limit of its uplink."""

    url: str
    """Address of the cloud, or those of its instances with commas between them."""
    token: str | None = field(default=None, repr=False)
    """The robot's bearer token; ``repr`` hides it."""
    ca: StrPath | None = None
    """PEM file of the authority that signed the cloud's certificate; None: the authorities of the system."""
    certificate: tuple[StrPath, StrPath] | None = None
    """PEM files of the robot's certificate and key, which replace the token."""
    budget_kBps: float | None = None
    """Limit of the uplink, kB per second by the stamps, above 0; None: everything is sent."""

    def __post_init__(self) -> None:
        if self.budget_kBps is not None and not self.budget_kBps > 0.0:
            raise InputError(f"budget_kBps={self.budget_kBps}; give a number above 0, or None for no limit")


def read_server(url: str, folder: Path | None, budget_kBps: float | None = None) -> Server:
    """A cloud with the credentials in a robot's folder, as `fcslam tools certificates` writes it.

    Each file may be missing. None: the cloud asks for none.
    """
    if folder is None:
        return Server(url, budget_kBps=budget_kBps)
    there = {name for name in (TOKEN, AUTHORITY, CERTIFICATE, KEY) if os.path.exists(folder / name)}
    if not there:
        raise InputError(
            f"{folder}: holds no credentials ({TOKEN}, {AUTHORITY}, {CERTIFICATE} and {KEY}); give a folder in "
            "credentials/robots, which `fcslam tools certificates` makes"
        )
    if (CERTIFICATE in there) != (KEY in there):
        raise InputError(f"{folder}: {CERTIFICATE} and {KEY} belong together; add the other one, or remove this one")
    return Server(
        url,
        read_token(folder / TOKEN) if TOKEN in there else None,
        folder / AUTHORITY if AUTHORITY in there else None,
        # a certificate is shown in TLS only
        (folder / CERTIFICATE, folder / KEY) if KEY in there and url.startswith("https:") else None,
        budget_kBps,
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
