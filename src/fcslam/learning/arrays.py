"""Named arrays in a file: `.npz` without pickle, replaced in one piece."""

import io
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a file and its folders; whatever happens, ``path`` holds all of the old file or all of the new one.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".part")
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    try:
        unfinished.write_bytes(content.getbuffer())
        unfinished.replace(path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Every array of a file.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no such file.
    """
    content = io.BytesIO(path.read_bytes())
    try:
        with np.load(content, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (BadZipFile, EOFError, KeyError, AttributeError, ValueError, zlib.error) as error:
        raise ValueError(f"no archive of arrays: {error}") from error
