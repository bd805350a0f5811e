"""Identity of robots: a robot signs each request with its private key, and the server knows the public keys.

TLS shows the robot that it talks to the server, and these signatures show the server which robot it talks to.
"""

import base64
import binascii
import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import quote, unquote

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    load_pem_private_key,
    load_ssh_private_key,
    load_ssh_public_key,
)

from fcslam.errors import TrainingError
from fcslam.federated.messages import MAX_NAME_LENGTH

ROBOT_HEADER: Final = "x-fcslam-robot"
"""Name of the robot, percent-encoded."""
TIME_HEADER: Final = "x-fcslam-time"
"""Seconds since 1970 by the robot's clock."""
DIGEST_HEADER: Final = "x-fcslam-sha256"
"""SHA-256 of the body, in hexadecimal digits."""
SIGNATURE_HEADER: Final = "x-fcslam-signature"
"""ECDSA signature with SHA-256, base64."""
CLOCK_TOLERANCE_S: Final = 120.0
"""Largest difference between the clocks of a robot and the server."""
_MAKE_ONE: Final = "make one: ssh-keygen -t ecdsa -b 384 -N '' -f ROBOT"


class RefusedRequestError(Exception):
    """A request is not by a robot of the fleet. The text names the reason."""


@dataclass(frozen=True, slots=True)
class RobotIdentity:
    """The name of a robot, and the private key that shows that the name is its own."""

    name: str
    key: ec.EllipticCurvePrivateKey | None
    """None in a fleet without authentication."""
    wall_clock: Callable[[], float] = time.time

    def headers(self, method: str, path: str, body: bytes) -> dict[str, str]:
        """The headers of a request that show who sends it."""
        headers = {ROBOT_HEADER: quote(self.name, safe="")}
        if self.key is None:
            return headers
        sent, digest = f"{self.wall_clock():.3f}", hashlib.sha256(body).hexdigest()
        text = _signed_text(method, path, headers[ROBOT_HEADER], sent, digest)
        signature = base64.b64encode(self.key.sign(text, ec.ECDSA(hashes.SHA256()))).decode("ascii")
        return headers | {TIME_HEADER: sent, DIGEST_HEADER: digest, SIGNATURE_HEADER: signature}


@dataclass(frozen=True, slots=True)
class RobotAuthenticator:
    """Decides which robot a request is by."""

    keys: Mapping[str, ec.EllipticCurvePublicKey] | None
    """Public key of each robot of the fleet, by the robot's name; None to believe every name."""
    wall_clock: Callable[[], float] = time.time

    def robot(self, method: str, path: str, headers: Mapping[str, str]) -> str:
        """The robot that sends a request with these headers. ``check_body`` checks the body, once it has arrived.

        Raises:
            RefusedRequestError: the request is by nobody in the fleet, or too old.
        """
        encoded = headers.get(ROBOT_HEADER, "")
        name = unquote(encoded, errors="replace")
        if not (0 < len(name) <= MAX_NAME_LENGTH and name.isprintable()):
            raise RefusedRequestError("it names no robot")
        if self.keys is None:
            return name
        sent, digest = headers.get(TIME_HEADER, ""), headers.get(DIGEST_HEADER, "")
        key = self.keys.get(name)
        if key is None:
            raise RefusedRequestError(f"the server has no key {name}.pub")
        try:
            signature = base64.b64decode(headers.get(SIGNATURE_HEADER, ""), validate=True)
            key.verify(signature, _signed_text(method, path, encoded, sent, digest), ec.ECDSA(hashes.SHA256()))
            age_s = self.wall_clock() - float(sent)
        except (InvalidSignature, binascii.Error, ValueError, UnicodeError) as error:
            raise RefusedRequestError(f"it is not signed with the private key of {name}.pub") from error
        if not abs(age_s) <= CLOCK_TOLERANCE_S:
            raise RefusedRequestError(
                f"the robot's clock differs by {age_s:.0f} s from the server's, at most {CLOCK_TOLERANCE_S:.0f} s"
            )
        return name

    def check_body(self, headers: Mapping[str, str], body: bytes) -> None:
        """Check that the body is the one that was signed.

        Raises:
            RefusedRequestError: it is another one.
        """
        if self.keys is not None and hashlib.sha256(body).hexdigest() != headers.get(DIGEST_HEADER):
            raise RefusedRequestError("its body is not the one that was signed")


def read_robot_keys(files: Sequence[Path]) -> dict[str, ec.EllipticCurvePublicKey]:
    """Public keys by robot: the key in ``robot1.pub`` is that of the robot called robot1.

    Raises:
        TrainingError: a file is not a public key, or two name the same robot.
    """
    keys: dict[str, ec.EllipticCurvePublicKey] = {}
    for file in files:
        try:
            key = load_ssh_public_key(file.read_bytes())
        except (OSError, ValueError, UnsupportedAlgorithm) as error:
            raise TrainingError(f"{file}: is not a public key of a robot ({error}); {_MAKE_ONE}") from error
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise TrainingError(f"{file}: is not an ECDSA key; {_MAKE_ONE}")
        if file.stem in keys:
            raise TrainingError(f"{file}: another key is that of {file.stem} too; a robot has its key file's name")
        keys[file.stem] = key
    return keys


def read_private_key(file: Path) -> ec.EllipticCurvePrivateKey:
    """A robot's private key.

    Raises:
        TrainingError: the file is not a private key, or is encrypted.
    """
    try:
        content = file.read_bytes()
        is_ssh = content.startswith(b"-----BEGIN OPENSSH")
        key = load_ssh_private_key(content, None) if is_ssh else load_pem_private_key(content, None)
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise TrainingError(f"{file}: is not a private key without a passphrase ({error}); {_MAKE_ONE}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TrainingError(f"{file}: is not an ECDSA key; {_MAKE_ONE}")
    return key


def _signed_text(method: str, path: str, robot: str, sent: str, digest: str) -> bytes:
    return "\n".join(("fcslam-federate-1", method, path, robot, sent, digest)).encode()
