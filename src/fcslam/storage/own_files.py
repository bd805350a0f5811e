"""Files that only the user who wrote them reads again: keyed hashes of the size and of the content come first.

The key is in the user's state folder. So a file that somebody else made or changed is as good as none, and one of
another size is not even read.
"""

import hashlib
import hmac
import os
import secrets
from pathlib import Path
from typing import Final

from fcslam.storage.files import write_file
from fcslam.untrusted import open_file, read_bytes

_KEY_BYTES: Final = 32
_HASH_BYTES: Final = 32


def write_own(path: Path, data: bytes) -> bool:
    """Write ``data`` for ``read_own``; False: this user has no folder for a key, and nothing is written.

    Raises:
        OSError: the file cannot be written.
    """
    key = _key()
    if key is None:
        return False
    write_file(path, _hash(key, _size(len(data))) + _hash(key, data) + data)
    return True


def read_own(path: Path) -> bytes | None:
    """Read the bytes that this user wrote to ``path``; None if the file is missing, or another user wrote or changed
    them.
    """
    key = _key()
    try:
        if key is None:
            return None
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size - 2 * _HASH_BYTES
            hash_of_size, hash_of_data = file.read(_HASH_BYTES), file.read(_HASH_BYTES)
            if not hmac.compare_digest(hash_of_size, _hash(key, _size(size))):
                return None
            data = file.read(size)
    except OSError:
        return None
    return data if hmac.compare_digest(hash_of_data, _hash(key, data)) else None


def _size(count: int) -> bytes:
    return count.to_bytes(8, "big", signed=True)


def _hash(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_HASH_BYTES, key=key).digest()


def _key() -> bytes | None:
    """The key of this user, made at the first use; None if there is no place for it."""
    try:
        folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "fcslam"
        path = folder / "key"
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            write_file(path, secrets.token_bytes(_KEY_BYTES), private=True)
        key = read_bytes(path)
    except (OSError, RuntimeError):  # no home
        return None
    return key if len(key) == _KEY_BYTES else None
