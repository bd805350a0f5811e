"""Files with which a robot shows who it is: tokens, and keys of TLS."""

import ssl
from pathlib import Path

from fcslam.errors import InputError


def no_passphrase() -> str:
    """Password callback for ``load_cert_chain``, so that OpenSSL does not ask on the terminal.

    Raises:
        ssl.SSLError: always; OpenSSL calls it only for an encrypted key.
    """
    raise ssl.SSLError("the key is encrypted; give one without a passphrase: openssl pkey -in KEY -out KEY2")


def read_token(path: Path) -> str:
    """The token in a file.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no token can be read ({error}); give the file that `fcslam setup certificates` wrote"
        ) from error
    if not token or not token.isprintable() or " " in token:
        raise InputError(f"{path}: holds no token; it should be one word")
    return token
