"""The result of a mission, in memory and as a run folder."""

from fcslam.runs.folder import (
    CONFIG,
    LOCAL,
    METRICS,
    POSE_GRAPH,
    TRAJECTORIES,
    Run,
    check_names,
    open_run,
    prepare_output,
)
from fcslam.runs.records import ClosureRow, Join, LocalizedPoses, LocalMap, Metric, RobotTrajectory
from fcslam.runs.separations import Separation, separations
from fcslam.runs.tables import metrics_json, read_tum, write_tum
from fcslam.runs.verdict import QUALITY, MapVerdict, Use

__all__ = [
    "CONFIG",
    "LOCAL",
    "METRICS",
    "POSE_GRAPH",
    "QUALITY",
    "TRAJECTORIES",
    "ClosureRow",
    "Join",
    "LocalMap",
    "LocalizedPoses",
    "MapVerdict",
    "Metric",
    "RobotTrajectory",
    "Run",
    "Separation",
    "Use",
    "check_names",
    "metrics_json",
    "open_run",
    "prepare_output",
    "read_tum",
    "separations",
    "write_tum",
]
