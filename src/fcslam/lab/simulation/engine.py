"""Loads MuJoCo and software GL on demand. Ray casting needs MuJoCo only; rendering also needs a GL library."""

import importlib
import os
import sys
from contextlib import suppress
from threading import RLock
from typing import Any

from fcslam.errors import InputError

_GL = "MUJOCO_GL"
_BACKENDS = ("egl", "osmesa")
GL_LOCK = RLock()
"""Serialises library loading and GL calls of the robots' threads. Mesa's software renderer reads the state of all
contexts of the process without a lock."""

_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"


def mujoco() -> Any:
    """Import ``mujoco`` without GL, which it would otherwise load at import.

    Raises:
        InputError: it is not installed.
    """
    with GL_LOCK:
        if loaded := sys.modules.get("mujoco"):
            return loaded
        wanted = os.environ.get(_GL)
        os.environ[_GL] = "disable"
        try:
            return importlib.import_module("mujoco")
        except ImportError as error:
            raise InputError(f"the simulator needs MuJoCo ({error}); pip install 'fcslam[sim]'") from error
        finally:
            os.environ.pop(_GL)
            if wanted is not None:
                os.environ[_GL] = wanted


def gl_context(width: int, height: int) -> Any:
    """Make an off-screen GL context current: EGL, or OSMesa without EGL. MUJOCO_GL selects one of them.

    Raises:
        InputError: there is no GL library.
    """
    mujoco()
    wanted = os.environ.get(_GL, "").lower()
    for backend in (wanted,) if wanted in _BACKENDS else _BACKENDS:
        # Without their library these modules raise ImportError, AttributeError or errors of GL.
        with suppress(Exception):
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
            return context
    raise InputError(
        f"no GL library for the cameras: apt-get install {_PACKAGES} (or libosmesa6), or leave the cameras off "
        "(--no-camera)"
    )
