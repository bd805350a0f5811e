"""fcslam: several robots map one building together.

    import fcslam

    run = fcslam.map_recordings(["robot1.clf", "robot2.clf"], output="runs/building")
    run.trajectories["robot1"].T_map_base  # poses (x, y, theta) at every scan, shape (N, 3)
    run.maps[0].cells  # the occupancy grid, shape (H, W)

Everything in ``__all__`` is public; modules load when a name is used for the first time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from fcslam.errors import (
    CloudError,
    ConfigError,
    EditError,
    EvaluationError,
    FcslamError,
    FeatureError,
    InputError,
    NetworkError,
    OutputError,
    OversizeError,
    PacketConflictError,
    PacketError,
    ServiceError,
    SimulationError,
    SourceError,
    StateError,
    StoreError,
    TrainingError,
    UnavailableError,
)

if TYPE_CHECKING:
    from fcslam.api import changes, localize, map_recordings
    from fcslam.live.localized_robot import LocalizedRobot
    from fcslam.live.records import EventKind, RobotEvent, RobotPose, RobotStatus
    from fcslam.live.robot import Robot
    from fcslam.mission.mission import MissionConfig, Progress
    from fcslam.records import CameraModel, Channel, ClosureStatus, LaserModel, Transform, Veto
    from fcslam.runs import (
        ClosureRow,
        LocalizedPoses,
        LocalMap,
        Metric,
        Occupancy,
        OccupancyMap,
        RobotTrajectory,
        Run,
        open_run,
    )
    from fcslam.sources import BagOptions
    from fcslam.wire.http_transport import Server

__version__ = "0.1.0"

__all__ = [
    "BagOptions",
    "CameraModel",
    "Channel",
    "ClosureRow",
    "ClosureStatus",
    "CloudError",
    "ConfigError",
    "EditError",
    "EvaluationError",
    "EventKind",
    "FcslamError",
    "FeatureError",
    "InputError",
    "LaserModel",
    "LocalMap",
    "LocalizedPoses",
    "LocalizedRobot",
    "Metric",
    "MissionConfig",
    "NetworkError",
    "Occupancy",
    "OccupancyMap",
    "OutputError",
    "OversizeError",
    "PacketConflictError",
    "PacketError",
    "Progress",
    "Robot",
    "RobotEvent",
    "RobotPose",
    "RobotStatus",
    "RobotTrajectory",
    "Run",
    "Server",
    "ServiceError",
    "SimulationError",
    "SourceError",
    "StateError",
    "StoreError",
    "TrainingError",
    "Transform",
    "UnavailableError",
    "Veto",
    "__version__",
    "changes",
    "localize",
    "map_recordings",
    "open_run",
]

_LAZY: Final = {
    "BagOptions": "fcslam.sources",
    "CameraModel": "fcslam.records",
    "Channel": "fcslam.records",
    "ClosureRow": "fcslam.runs",
    "ClosureStatus": "fcslam.records",
    "EventKind": "fcslam.live.records",
    "LaserModel": "fcslam.records",
    "LocalMap": "fcslam.runs",
    "LocalizedPoses": "fcslam.runs",
    "LocalizedRobot": "fcslam.live.localized_robot",
    "Metric": "fcslam.runs",
    "MissionConfig": "fcslam.mission.mission",
    "Occupancy": "fcslam.runs",
    "OccupancyMap": "fcslam.runs",
    "Progress": "fcslam.mission.mission",
    "Robot": "fcslam.live.robot",
    "RobotEvent": "fcslam.live.records",
    "RobotPose": "fcslam.live.records",
    "RobotStatus": "fcslam.live.records",
    "RobotTrajectory": "fcslam.runs",
    "Run": "fcslam.runs",
    "Server": "fcslam.wire.http_transport",
    "Transform": "fcslam.records",
    "Veto": "fcslam.records",
    "changes": "fcslam.api",
    "localize": "fcslam.api",
    "map_recordings": "fcslam.api",
    "open_run": "fcslam.runs",
}
"""Where each name is that is imported at its first use."""


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'fcslam' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_LAZY[name]), name)
    return value


def __dir__() -> list[str]:
    return list(__all__)
