"""`fcslam tools warm-up`, and how other commands wait for code that is not compiled yet."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fcslam.cli.output import notices, print_line

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import Console

    from fcslam.robot.frontend import RobotConfig

FIRST_SCANS_S, EVERYTHING_S = 15, 60
"""About what compiling takes on one core of a laptop: what first scans need, and everything."""


def warm_up() -> None:
    """Compile the code of robots and cloud now, on all cores, so that the first run starts at once."""
    from fcslam.warmup import WARM_UPS, compiling, warm_up_space

    console = notices()
    if report_uncached(console):
        return
    print_line(console, f"compiling, about {EVERYTHING_S} s on one core")
    runs = *WARM_UPS, warm_up_space
    if cores() == 1:
        for run in runs:
            run()
    else:
        with compiling(cores() + 1, runs) as copies:  # this process waits most of the time
            for copy in copies:
                copy.join()
    print_line(console, "the code is compiled")


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def report_uncached(console: "Console") -> bool:
    """Say so if compiled code cannot be kept; returns whether that is so."""
    from fcslam.compiled import uncached

    if uncached():
        print_line(
            console,
            f"compiled code cannot be kept, so every start takes about {EVERYTHING_S} s longer; "
            "set NUMBA_CACHE_DIR to a folder that can be written",
        )
    return uncached()


@contextmanager
def compiled(console: "Console", lidar_3d: bool = False) -> Iterator[None]:
    """Wait until the code for the first scans is compiled and say why; the rest is compiled meanwhile.

    A robot with a 3D LiDAR needs other code, which it compiles as it starts.
    """
    from fcslam.warmup import compiling, is_cold

    if report_uncached(console) or lidar_3d or not is_cold():
        yield
        return
    processes = cores()
    first = "" if processes == 1 else f"about {FIRST_SCANS_S} s until the first scan, "
    print_line(console, f"compiling, first run only: {first}about {EVERYTHING_S} s until full speed")
    with compiling(processes):
        yield


@contextmanager
def copied_process(config: "RobotConfig | None") -> "Iterator[Executor]":
    """One worker, a copy of this process, until the end of this block; begin it before threads start.

    With ``config``, that of a robot with a 2D LiDAR, both processes share the memory of the tracker's code, unless that
    is not compiled yet: nobody waits for a compiler here.
    """
    from fcslam.robot.backend_runner import copied_worker
    from fcslam.warmup import is_cold, warm_up_tracking

    if config is not None and not is_cold():
        warm_up_tracking(config)
    gc.freeze()
    with copied_worker() as worker:
        yield worker
