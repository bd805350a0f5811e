"""Atomic writes: a file or a folder holds all of its old content or all of the new one.

A file of ``write_file`` does so also after a power cut.

A folder is replaced in two steps. A process that is killed between them leaves none; ``bring_back`` undoes the first.
"""

import glob
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write_file(path: Path, content: bytes | memoryview | str, *, private: bool = False) -> None:
    """Replace a file atomically; ``private``: only the owner may read it, from the first moment."""
    data = content.encode() if isinstance(content, str) else content
    with replacing(path) as unfinished:
        mode = 0o600 if private else 0o666
        with os.fdopen(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # else the name may be there after a power cut, without the content


def keep_private() -> None:
    """Let only the owner read what this process and its children write from now on: files 0600, folders 0700."""
    os.umask(0o077)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path beside ``path`` for a file to be written; it replaces ``path`` when the block succeeds."""
    unfinished = path.with_name(f".{path.name}.partial")
    unfinished.unlink(missing_ok=True)
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Give a new folder beside ``path``; it replaces ``path`` when the block succeeds and is removed otherwise."""
    bring_back(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.partial")
    retired = path.with_name(f".{path.name}.{os.getpid()}.retired")
    try:
        unfinished.mkdir()
        yield unfinished
        if path.exists():
            path.rename(retired)
        try:
            unfinished.rename(path)
        finally:
            bring_back(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        shutil.rmtree(retired, ignore_errors=True)


def bring_back(path: Path) -> None:
    """Give the old folder its name again if a process was killed while it replaced it."""
    if not path.exists():
        for retired in path.parent.glob(f".{glob.escape(path.name)}.*.retired"):
            retired.rename(path)
            return
