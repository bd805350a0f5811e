"""A lock around numba's cache of compiled functions, for tests in several processes."""

import fcntl
from functools import wraps
from pathlib import Path

from numba.core.caching import IndexDataCacheFile


def lock_numba_cache() -> None:
    """Let one process at a time read or write the cache of a module.

    numba writes the index before the machine code. Without a lock, a process that reads between the two can load the
    code of an older source, and two processes can give one file name to the code of two signatures.
    """
    for name in ("load", "save"):
        setattr(IndexDataCacheFile, name, _locked(getattr(IndexDataCacheFile, name)))


def _locked(method):
    @wraps(method)
    def wrapper(self, *arguments):
        folder = Path(self._cache_path)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "numba.lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            return method(self, *arguments)

    return wrapper
