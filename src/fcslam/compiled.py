"""Compiled functions and the cache of their machine code, which works without a folder for it as well.

Compiling takes half a minute, loading from the cache less than a second. The cache is in the user's cache folder, or
beside the sources of a clone; ``NUMBA_CACHE_DIR`` names another. If none can be written, every process compiles.
"""

import fcntl
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.core.runtime import nrtdynmod, rtsys

_uncached: list[str] = []


def uncached() -> bool:
    """Whether there is no folder for the machine code of the functions that are loaded so far."""
    return bool(_uncached)


def is_compiled(function: Any) -> bool:
    """Whether the cache has machine code for a compiled function as its source is now."""
    with suppress(OSError):
        return isinstance(function._cache, _Cache) and bool(function._cache._cache_file._load_index())
    return False


def njit(function: Any = None, *, nogil: bool = False, allocates: bool = True) -> Any:
    """As ``numba.njit`` with a cache, if there can be one.

    A function that makes no array may say so with ``allocates=False``. It then counts no references to the arrays it is
    given and is inlined: both would cost a short function more than its work.
    """
    if function is None:
        return lambda function: njit(function, nogil=nogil, allocates=allocates)
    dispatcher = numba.njit(nogil=nogil, error_model="numpy", _nrt=allocates, forceinline=not allocates)(function)
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError:  # no locator available: no folder can be written
        _uncached.append(function.__name__)
    return dispatcher


@cache
def _load_array_functions() -> None:
    """Load those of numba without the BLAS of SciPy, which takes 0.3 s and 16 MB.

    numba loads it to learn whether it is there, and looks again before it compiles a product of matrices.
    """
    from numba.np import linalg

    ensure_blas = getattr(linalg, "ensure_blas", None)  # not a public name
    linalg.ensure_blas = lambda: None
    try:
        import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = ensure_blas


@cache
def _initialize_runtime(context: Any, folder: str) -> None:
    """Initialise the runtime of numba by machine code from a folder: the compiler's pages would take 20 MB."""
    compile_runtime, codegen = nrtdynmod.compile_nrt_functions, context.codegen()
    file, machine = IndexDataCacheFile(folder, "runtime", ""), codegen.magic_tuple()

    def load_runtime(context: Any) -> Any:
        stored = file.load(machine)
        if stored is not None:
            return codegen.unserialize_library(stored)
        library = codegen.create_library("nrt")
        library.enable_object_caching()
        library.add_ir_module(nrtdynmod.create_nrt_module(context)[0])
        library.finalize()
        file.save(machine, library.serialize_using_object_code())
        return library

    nrtdynmod.compile_nrt_functions = load_runtime
    try:
        rtsys.initialize(context)
    finally:
        nrtdynmod.compile_nrt_functions = compile_runtime


class _CachedCode(CompileResultCacheImpl):  # type: ignore[misc]
    """Finds the folder for machine code: not in an installed package, as ``pip uninstall`` would leave it there."""

    _locator_classes: Sequence[type] = CompileResultCacheImpl._locator_classes

    def __init__(self, function: Any) -> None:
        if {"site-packages", "dist-packages"} & set(Path(function.__code__.co_filename).parts):
            self._locator_classes = [UserProvidedCacheLocator, UserWideCacheLocator, *self._locator_classes]
        super().__init__(function)


class _Cache(FunctionCache):  # type: ignore[misc]
    """A cache that several processes may use at a time, and that may fail."""

    _impl_class = _CachedCode

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As numba's, but it does not load all that only the compiler needs, which takes 0.2 s and 11 MB."""
        _load_array_functions()
        with suppress(OSError), self._locked():
            _initialize_runtime(target_context, self.cache_path)
            return self._load_overload(sig, target_context)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError), self._locked():
            super().save_overload(sig, data)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """numba writes the index before the machine code: another process could load the code of an older source."""
        folder = Path(self.cache_path)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "numba.lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


@njit(allocates=False)
def assign(target: Any, source: Any) -> None:
    """``target[:] = source`` in compiled code; numba compiles that for two seconds, for the message of an error."""
    for k in range(len(target)):
        target[k] = source[k]
