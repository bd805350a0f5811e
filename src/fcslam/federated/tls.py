"""Certificates and addresses. Certificates are checked before anything starts, so that a mistake is one line."""

import contextlib
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fcslam.errors import TrainingError
from fcslam.wire.keys import no_passphrase

TIMEOUT_S: Final = 10.0
"""Time for a handshake with the server."""
MAX_FLIGHTS: Final = 8
"""A TLS handshake takes fewer turns of both sides than this."""


@dataclass(frozen=True, slots=True)
class Certificates:
    """PEM files of the server."""

    ca: Path
    """Certificate of the authority that signed the server's."""
    certificate: Path
    key: Path
    """Private key of ``certificate``."""


@dataclass(frozen=True, slots=True)
class Address:
    """Address on which the server listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def check_own_certificate(certificates: Certificates, host: str) -> None:
    """Check this machine's certificate by a handshake with itself, in memory.

    Raises:
        TrainingError: the key does not belong to the certificate, the authority did not sign it, it has expired, or it
            does not name ``host``.
    """
    outgoing, incoming = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(certificates.certificate, certificates.key, no_passphrase)
    except (ssl.SSLError, OSError) as error:
        raise TrainingError(
            f"{certificates.key}: is not the key of {certificates.certificate} ({_reason(error)}); give its key"
        ) from error
    there = server.wrap_bio(outgoing, incoming, server_side=True)
    here = client_context(certificates.ca).wrap_bio(incoming, outgoing, server_hostname=host)
    try:
        for side in [here, there] * MAX_FLIGHTS:
            with contextlib.suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except ssl.SSLError as error:
        raise TrainingError(
            f"{certificates.certificate}: does not fit {certificates.ca} and {host} ({_reason(error)}); "
            "sign it with that authority, for that name"
        ) from error


def check_server_certificate(address: Address, ca: Path) -> None:
    """Check the server's certificate by a handshake, if the server is there already.

    Raises:
        TrainingError: the server has no certificate, or one that the authority did not sign for this name.
    """
    context = client_context(ca)
    try:
        with (
            socket.create_connection((address.host, address.port), timeout=TIMEOUT_S) as connection,
            context.wrap_socket(connection, server_hostname=address.host),
        ):
            return
    except (ssl.SSLEOFError, ssl.SSLZeroReturnError):
        return  # the server closed the connection, which says nothing about its certificate
    except ssl.SSLError as error:
        raise TrainingError(
            f"{address}: the server's certificate does not fit {ca} and this name ({_reason(error)}); "
            "ask for the authority that signed it"
        ) from error
    except OSError:
        return  # the server may start later


def client_context(ca: Path) -> ssl.SSLContext:
    """A context that trusts this authority and no other.

    Raises:
        TrainingError: the file is not a certificate.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(ca)
    except (ssl.SSLError, OSError) as error:
        raise TrainingError(f"{ca}: is not a certificate of an authority ({_reason(error)})") from error
    return context


def _reason(error: OSError) -> str:
    """The cause in a few words."""
    words = getattr(error, "verify_message", "") or getattr(error, "reason", "") or str(error)
    return " ".join(str(words).lower().replace("_", " ").split())
