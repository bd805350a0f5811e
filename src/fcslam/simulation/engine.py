"""MuJoCo and software GL, loaded when they are needed. Rays need MuJoCo alone, pictures a GL library as well."""

import importlib
import os
import sys
from contextlib import suppress
from threading import RLock
from typing import Any

from fcslam.errors import SimulationError

_GL = "MUJOCO_GL"
_BACKENDS = ("egl", "osmesa")
GL_LOCK = RLock()
"""Robots are simulated side by side in threads. Whoever loads a library or calls GL does so alone: Mesa's software
renderer looks through what all contexts of the process are drawing, without asking whether one of them is at it."""

_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"


def mujoco() -> Any:
    """The module; it is imported without GL, which it would otherwise look for at once.

    Raises:
        SimulationError: it is not installed.
    """
    with GL_LOCK:
        if loaded := sys.modules.get("mujoco"):
            return loaded
        wanted = os.environ.get(_GL)
        os.environ[_GL] = "disable"
        try:
            return importlib.import_module("mujoco")
        except ImportError as error:
            raise SimulationError(f"the simulator needs MuJoCo ({error}); pip install 'fcslam[sim]'") from error
        finally:
            os.environ.pop(_GL)
            if wanted is not None:
                os.environ[_GL] = wanted


def gl_context(width: int, height: int) -> Any:
    """A current off-screen GL context: EGL, or OSMesa where there is no EGL; MUJOCO_GL asks for one of them.

    Raises:
        SimulationError: there is no GL library.
    """
    mujoco()
    wanted = os.environ.get(_GL, "").lower()
    for backend in (wanted,) if wanted in _BACKENDS else _BACKENDS:
        # Without their library these modules fail in ways of their own: ImportError, AttributeError, GL's errors.
        with suppress(Exception):
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
            return context
    raise SimulationError(
        f"no GL library for the cameras: apt-get install {_PACKAGES} (or libosmesa6), or leave the cameras off "
        "(--no-camera)"
    )
