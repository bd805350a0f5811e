"""Named arrays in `.npz` files: without pickle, written atomically."""

import io
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from fcslam.storage.files import write_file


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a file atomically; its folder is created if it does not exist.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    write_file(path, content.getbuffer())


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Every array of a file.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not an archive of arrays, or is broken.
    """
    content = io.BytesIO(path.read_bytes())
    try:
        with np.load(content, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (BadZipFile, EOFError, KeyError, AttributeError, ValueError, zlib.error) as error:
        raise ValueError(f"no archive of arrays: {error}") from error
