"""Whether certificates fit, asked before Flower is started: its processes try again and again and say little."""

import contextlib
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fcslam.errors import TrainingError
from fcslam.wire.keys import no_passphrase

PATIENCE_S: Final = 10.0
FLIGHTS: Final = 8
"""A handshake is over after so many turns."""


@dataclass(frozen=True, slots=True)
class Certificates:
    """PEM files of one machine."""

    ca: Path
    certificate: Path
    key: Path

    def options(self) -> list[str]:
        """For Flower's daemons."""
        files = ("--ssl-ca-certfile", self.ca), ("--ssl-certfile", self.certificate), ("--ssl-keyfile", self.key)
        return [word for option, file in files for word in (option, str(file.resolve()))]


@dataclass(frozen=True, slots=True)
class Address:
    """Where the server listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def check_own_certificate(certificates: Certificates, host: str) -> None:
    """Let this machine shake hands with itself, in memory.

    Raises:
        TrainingError: the key is not the certificate's, the authority did not sign it or it has expired, or it does
            not name ``host``.
    """
    outgoing, incoming = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(certificates.certificate, certificates.key, no_passphrase)
    except (ssl.SSLError, OSError) as error:
        raise TrainingError(
            f"{certificates.key}: is no key of {certificates.certificate} ({_reason(error)}); give both of one pair"
        ) from error
    there = server.wrap_bio(outgoing, incoming, server_side=True)
    here = _trusting(certificates.ca).wrap_bio(incoming, outgoing, server_hostname=host)
    try:
        for side in [here, there] * FLIGHTS:
            with contextlib.suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except ssl.SSLError as error:
        raise TrainingError(
            f"{certificates.certificate}: does not fit {certificates.ca} and {host} ({_reason(error)}); "
            "sign it with that authority, for that name"
        ) from error


def check_server_certificate(address: Address, ca: Path) -> None:
    """Shake hands with the server, if it is there already.

    Raises:
        TrainingError: somebody listens there, but with a certificate that the authority did not sign for this name,
            or without any.
    """
    context = _trusting(ca)
    try:
        with (
            socket.create_connection((address.host, address.port), timeout=PATIENCE_S) as connection,
            context.wrap_socket(connection, server_hostname=address.host),
        ):
            return
    except (ssl.SSLEOFError, ssl.SSLZeroReturnError):
        return  # it hung up: that says nothing of its certificate
    except ssl.SSLError as error:
        raise TrainingError(
            f"{address}: the server's certificate does not fit {ca} and this name ({_reason(error)}); "
            "ask for the authority that signed it"
        ) from error
    except OSError:
        return  # it may come later


def _trusting(ca: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(ca)
    except (ssl.SSLError, OSError) as error:
        raise TrainingError(f"{ca}: is no certificate of an authority ({_reason(error)})") from error
    return context


def _reason(error: OSError) -> str:
    """In a few words."""
    words = getattr(error, "verify_message", "") or getattr(error, "reason", "") or str(error)
    return " ".join(str(words).lower().replace("_", " ").split())
