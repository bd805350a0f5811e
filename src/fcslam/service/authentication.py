"""Authentication by bearer tokens, of which the service stores the SHA-256 only, or by a robot's certificate."""

import hashlib
import hmac
from collections.abc import Sequence
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.x509.oid import NameOID
from pydantic import AwareDatetime, Field

from fcslam.cloud.sessions import check_robot
from fcslam.config import Settings, load
from fcslam.errors import InputError, PacketError
from fcslam.records import NAME


class Role(StrEnum):
    """Role of a token."""

    ROBOT = "robot"
    """Sends packets as the robot that it names."""
    VIEWER = "viewer"
    """Reads everything."""
    ADMIN = "admin"
    """Reads everything, and decides about missions."""


VIEWERS = Role.VIEWER, Role.ADMIN
"""Roles that read everything."""


class Identity(NamedTuple):
    """The client of a request."""

    name: str
    role: Role


class TokenEntry(Settings):
    """One token."""

    name: str = Field(pattern=f"^{NAME.pattern}$", description="of the robot or person that holds the token")
    role: Role = Field(description="robot, viewer or admin")
    sha256: str = Field(pattern="^[0-9a-f]{64}$", description="of the token, in hexadecimal")
    expires: AwareDatetime | None = Field(
        default=None, description="when the token ends, with a time zone, as 2027-01-31T00:00:00Z; never without it"
    )


class TokensFile(Settings):
    """All tokens."""

    tokens: tuple[TokenEntry, ...] = Field(description="who may ask")


class Authenticator:
    """Tells who has a token."""

    def __init__(self, tokens: Sequence[TokenEntry] | None) -> None:
        """None: no authentication; every client may do everything."""
        self._tokens = tokens

    def replace(self, tokens: Sequence[TokenEntry]) -> list[str]:
        """Use these tokens from the next request on; returns the names whose token is new, gone or another one."""
        changed = sorted({entry.name for entry in set(tokens) ^ set(self._tokens or ())})
        self._tokens = tokens
        return changed

    @property
    def is_open(self) -> bool:
        """Whether authentication is off."""
        return self._tokens is None

    def who(self, authorization: str | None, certificate: str | None = None) -> Identity | None:
        """Whose token an ``Authorization`` header has, or whose certificate there is without one; None if nobody's.

        ``certificate``: the name (RFC 4514) in one whose signature was checked.
        """
        return self._by_token(authorization) if authorization or certificate is None else _by_name(certificate)

    def _by_token(self, authorization: str | None) -> Identity | None:
        """Constant time, so that timing reveals nothing."""
        scheme, _, token = (authorization or "").partition(" ")
        digest = hashlib.sha256(token.strip().encode("utf-8", "surrogateescape")).hexdigest()
        found = None
        for entry in self._tokens or ():
            if hmac.compare_digest(entry.sha256, digest) and scheme.lower() == "bearer":
                is_valid = entry.expires is None or datetime.now(UTC) < entry.expires
                found = Identity(entry.name, entry.role) if is_valid else None
        return found


def _by_name(certificate: str) -> Identity | None:
    try:
        names = x509.Name.from_rfc4514_string(certificate).get_attributes_for_oid(NameOID.COMMON_NAME)
        name = str(names[0].value) if len(names) == 1 else ""
        check_robot(name)
    except (PacketError, ValueError):
        return None
    return Identity(name, Role.ROBOT)


def read_tokens(path: Path) -> tuple[TokenEntry, ...]:
    """Tokens of a file."""
    tokens = load(TokensFile, path).tokens
    for what in ("sha256", "name"):
        values = [getattr(entry, what) for entry in tokens]
        double = next((entry for entry in tokens if values.count(getattr(entry, what)) > 1), None)
        if double:
            raise InputError(f"{path}: two entries have the {what} of '{double.name}'; each needs its own")
    return tokens
