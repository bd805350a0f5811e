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
    FcslamError,
    FeatureError,
    InputError,
    OversizeError,
    PacketConflictError,
    PacketError,
    SourceError,
    StoreError,
    UnavailableError,
)

if TYPE_CHECKING:
    from fcslam.anchoring.anchors import Anchors, read_anchors
    from fcslam.api import changes, localize, map_recordings
    from fcslam.live.localized_robot import LocalizedRobot
    from fcslam.live.records import EventKind, LocalizationState, RobotEvent, RobotPose, RobotStatus
    from fcslam.live.robot import Robot
    from fcslam.maps.changes import ChangedRegion, Changes
    from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
    from fcslam.mission.localization import LocalizationProgress
    from fcslam.mission.mission import MissionConfig, Progress
    from fcslam.records import (
        Beams,
        CameraImage,
        CameraModel,
        Channel,
        ClosureStatus,
        GnssFix,
        LaserModel,
        LaserScan,
        Odometry,
        Reason,
        ReasonCode,
        Sweep,
        Transform,
        Veto,
    )
    from fcslam.robot.outbox import WaitingPackets
    from fcslam.runs import (
        ClosureRow,
        Join,
        LocalizedPoses,
        LocalMap,
        Metric,
        RobotTrajectory,
        Run,
        open_run,
    )
    from fcslam.sources import BagOptions, Fault, FaultCount, Faults, ScanRange, Source, Survey
    from fcslam.sources.point_clouds import CloudBand
    from fcslam.wire.http_transport import Server

__version__ = "0.1.0"

__all__ = [
    "Anchors",
    "BagOptions",
    "Beams",
    "CameraImage",
    "CameraModel",
    "ChangedRegion",
    "Changes",
    "Channel",
    "ClosureRow",
    "ClosureStatus",
    "CloudBand",
    "CloudError",
    "EventKind",
    "Fault",
    "FaultCount",
    "Faults",
    "FcslamError",
    "FeatureError",
    "GnssFix",
    "InputError",
    "Join",
    "LaserModel",
    "LaserScan",
    "LocalMap",
    "LocalizationProgress",
    "LocalizationState",
    "LocalizedPoses",
    "LocalizedRobot",
    "Metric",
    "MissionConfig",
    "Occupancy",
    "OccupancyMap",
    "Odometry",
    "OversizeError",
    "PacketConflictError",
    "PacketError",
    "Progress",
    "Reason",
    "ReasonCode",
    "Robot",
    "RobotEvent",
    "RobotPose",
    "RobotStatus",
    "RobotTrajectory",
    "Run",
    "ScanRange",
    "Server",
    "Source",
    "SourceError",
    "StoreError",
    "Survey",
    "Sweep",
    "Transform",
    "UnavailableError",
    "Veto",
    "WaitingPackets",
    "__version__",
    "changes",
    "localize",
    "map_recordings",
    "open_run",
    "read_anchors",
]

_LAZY: Final = {
    name: module
    for module, names in {
        "fcslam.anchoring.anchors": "Anchors read_anchors",
        "fcslam.api": "changes localize map_recordings",
        "fcslam.live.localized_robot": "LocalizedRobot",
        "fcslam.live.records": "EventKind LocalizationState RobotEvent RobotPose RobotStatus",
        "fcslam.live.robot": "Robot",
        "fcslam.maps.changes": "ChangedRegion Changes",
        "fcslam.maps.occupancy_map": "Occupancy OccupancyMap",
        "fcslam.mission.localization": "LocalizationProgress",
        "fcslam.mission.mission": "MissionConfig Progress",
        "fcslam.records": "Beams CameraImage CameraModel Channel ClosureStatus GnssFix LaserModel LaserScan "
        "Odometry Reason ReasonCode Sweep Transform Veto",
        "fcslam.robot.outbox": "WaitingPackets",
        "fcslam.runs": "ClosureRow Join LocalMap LocalizedPoses Metric RobotTrajectory Run open_run",
        "fcslam.sources": "BagOptions Fault FaultCount Faults ScanRange Source Survey",
        "fcslam.sources.point_clouds": "CloudBand",
        "fcslam.wire.http_transport": "Server",
    }.items()
    for name in names.split()
}
"""Where each name is that is imported at its first use."""


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'fcslam' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_LAZY[name]), name)
    return value


def __dir__() -> list[str]:
    return list(__all__)
