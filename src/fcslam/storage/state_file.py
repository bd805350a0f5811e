"""A program's state as a file: JSON and arrays, with a hash of all of it. Nothing in it is executed.

The file is an uncompressed ``.npz`` without pickled objects, after the BLAKE2b hash of its bytes.
"""

import hashlib
import io
import json
import zipfile
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.config import one_line
from fcslam.errors import InputError
from fcslam.storage.files import write_file
from fcslam.untrusted import read_bytes

State = dict[str, Any]
"""JSON values and, below any depth of dictionaries with keys of text, arrays."""

_HASH_BYTES = 32
_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless")


def write_state(path: Path, fits: str, state: State) -> None:
    """Write a state atomically; ``fits``: what it fits, a program of a version, for instance."""
    arrays: dict[str, NDArray[Any]] = {}

    def number(array: NDArray[Any]) -> dict[str, str]:
        arrays[str(len(arrays))] = array
        return {"": str(len(arrays) - 1)}  # the only key in place of an array; no name is empty

    text = json.dumps({"fits": fits, "state": state}, default=number)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, text=np.frombuffer(text.encode(), np.uint8), **arrays)
    write_file(path, _hash(content.getvalue()) + content.getvalue())


def read_state(path: Path, fits: str) -> State | None:
    """Read a state; None if there is no file, an ``InputError`` if it cannot be read, is damaged or does not fit."""
    try:
        data = read_bytes(path)
        if _hash(data[_HASH_BYTES:]) != data[:_HASH_BYTES]:
            raise InputError(f"{path}: is damaged")
        with np.load(io.BytesIO(data[_HASH_BYTES:]), allow_pickle=False) as archive:
            about: State = json.loads(
                archive["text"].tobytes(),
                object_hook=lambda found: archive[found[""]] if found.keys() == {""} else found,
            )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read ({one_line(str(error))})") from error
    if about["fits"] != fits:
        raise InputError(f"{path}: is of another version or configuration")
    state: State = about["state"]
    return state


@cache
def code_version() -> str:
    """Hash of the program and the libraries that it computes with: others may decide otherwise with the same state."""
    hashed = hashlib.blake2b(" ".join(map(version, _LIBRARIES)).encode(), digest_size=16)
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        hashed.update(path.read_bytes())
    return hashed.hexdigest()


def _hash(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_HASH_BYTES).digest()
