"""The run folder: what a mission leaves behind."""

from fcslam.runs.folder import (
    LOCAL,
    POSE_GRAPH,
    TRAJECTORIES,
    Run,
    check_names,
    open_run,
    prepare_output,
)
from fcslam.runs.records import ClosureRow, LocalMap, Metric, RobotTrajectory
from fcslam.runs.tables import metrics_json, read_vetoes
from fcslam.runs.trajectories import read_tum, write_tum

__all__ = [
    "LOCAL",
    "POSE_GRAPH",
    "TRAJECTORIES",
    "ClosureRow",
    "LocalMap",
    "Metric",
    "RobotTrajectory",
    "Run",
    "check_names",
    "metrics_json",
    "open_run",
    "prepare_output",
    "read_tum",
    "read_vetoes",
    "write_tum",
]
