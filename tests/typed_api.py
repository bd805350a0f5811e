"""A program of a user, which mypy checks as it checks the package: type checkers know the public API."""

from pathlib import Path
from typing import assert_type

import numpy as np
from numpy.typing import NDArray

import fcslam


def count(progress: fcslam.Progress) -> None:
    assert_type(progress.scans, int)


run = fcslam.map_recordings(["a.clf", Path("b.clf")], split=1, progress=count)
assert_type(run, fcslam.Run)
assert_type(run.trajectories["a"].T_map_base, NDArray[np.float64])
assert_type(run.maps[0].origin_xy, tuple[float, float])
assert_type(run.metrics["maps"].value, float)
assert_type([closure.status for closure in run.closures], list[fcslam.ClosureStatus])
assert_type(fcslam.open_run("runs/building"), fcslam.Run)
fcslam.map_recordings("a.clf", seeds=1)  # type: ignore[call-arg]
