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

from fcslam.errors import InputError
from fcslam.storage.files import write_file
from fcslam.untrusted import read_bytes

State = dict[str, Any]
"""JSON values and, below any depth of dictionaries with keys of text, arrays."""

_ARRAY = ""
"""The only key of a dictionary that stands for an array, with its number as its value; no name is empty."""
_HASH_BYTES = 32
_LIBRARIES = ("numpy", "scipy", "numba", "gtsam", "opencv-python-headless")


def write_state(path: Path, fits: str, state: State) -> None:
    """Write a state atomically.

    Args:
        path: the file; its folder exists.
        fits: what the state fits: a program of a version, for instance.
        state: what is written.
    """
    data = state_bytes(fits, state)
    write_file(path, _hash(data) + data)


def state_bytes(fits: str, state: State) -> bytes:
    """The content of a state's file, without a hash."""
    arrays: list[NDArray[Any]] = []
    text = json.dumps({"fits": fits, "state": _without_arrays(state, arrays)})
    content = io.BytesIO()
    named = {str(number): array for number, array in enumerate(arrays)}
    np.savez(content, allow_pickle=False, text=np.frombuffer(text.encode(), np.uint8), **named)
    return content.getvalue()


def read_state(path: Path, fits: str) -> State | None:
    """Read a state; None if there is no file.

    Raises:
        InputError: the file cannot be read, is damaged, or does not fit.
    """
    try:
        data = read_bytes(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    if _hash(data[_HASH_BYTES:]) != data[:_HASH_BYTES]:
        raise InputError(f"{path}: is damaged")
    return parse_state(path, data[_HASH_BYTES:], fits)


def parse_state(path: Path, data: bytes, fits: str) -> State:
    """Read what ``state_bytes`` gave, found at ``path``."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            about = json.loads(archive["text"].tobytes())
            if about["fits"] != fits:
                raise InputError(f"{path}: is of another version or configuration")
            state: State = _with_arrays(about["state"], archive)
            return state
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read ({' '.join(str(error).split())})") from error


@cache
def code_version() -> str:
    """Hash of the program and of the libraries that it computes with: others may decide otherwise, so a state fits no
    other one."""
    hashed = hashlib.blake2b(" ".join(map(version, _LIBRARIES)).encode(), digest_size=16)
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        hashed.update(path.read_bytes())
    return hashed.hexdigest()


def _hash(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_HASH_BYTES).digest()


def _without_arrays(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """The value with a number in place of each array, which is appended to ``arrays``."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    return {key: _without_arrays(item, arrays) for key, item in value.items()} if isinstance(value, dict) else value


def _with_arrays(value: Any, archive: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if value.keys() == {_ARRAY}:
        return archive[str(value[_ARRAY])]
    return {key: _with_arrays(item, archive) for key, item in value.items()}
