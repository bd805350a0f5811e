"""fcslam: several robots map one building together.

    import fcslam

    run = fcslam.map_recordings(["robot1.clf", "robot2.clf"], output="runs/building")
    run.trajectories["robot1"].T_map_base  # poses (x, y, theta) at every scan, shape (N, 3)
    run.maps[0].cells  # the occupancy grid, shape (H, W)

Everything in ``__all__`` is public. Modules load when a name is used for the first time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from fcslam.errors import CloudError as CloudError
from fcslam.errors import FcslamError as FcslamError
from fcslam.errors import FeatureError as FeatureError
from fcslam.errors import InputError as InputError
from fcslam.errors import OversizeError as OversizeError
from fcslam.errors import PacketConflictError as PacketConflictError
from fcslam.errors import PacketError as PacketError
from fcslam.errors import SourceError as SourceError
from fcslam.errors import StoreError as StoreError
from fcslam.errors import UnavailableError as UnavailableError

if TYPE_CHECKING:  # the names of ``_LAZY``, for type checkers
    from fcslam.anchoring.anchors import Anchors as Anchors
    from fcslam.anchoring.anchors import read_anchors as read_anchors
    from fcslam.api import changes as changes
    from fcslam.api import localize as localize
    from fcslam.api import map_recordings as map_recordings
    from fcslam.live.localized_robot import LocalizedRobot as LocalizedRobot
    from fcslam.live.records import EventKind as EventKind
    from fcslam.live.records import LocalizationState as LocalizationState
    from fcslam.live.records import RobotEvent as RobotEvent
    from fcslam.live.records import RobotPose as RobotPose
    from fcslam.live.records import RobotStatus as RobotStatus
    from fcslam.live.robot import Robot as Robot
    from fcslam.maps.changes import ChangedRegion as ChangedRegion
    from fcslam.maps.changes import Changes as Changes
    from fcslam.maps.occupancy_map import Occupancy as Occupancy
    from fcslam.maps.occupancy_map import OccupancyMap as OccupancyMap
    from fcslam.mission.localization import LocalizationProgress as LocalizationProgress
    from fcslam.mission.mission import MissionConfig as MissionConfig
    from fcslam.mission.mission import Progress as Progress
    from fcslam.records import Beams as Beams
    from fcslam.records import CameraImage as CameraImage
    from fcslam.records import CameraModel as CameraModel
    from fcslam.records import Channel as Channel
    from fcslam.records import ClosureStatus as ClosureStatus
    from fcslam.records import GnssFix as GnssFix
    from fcslam.records import LaserModel as LaserModel
    from fcslam.records import LaserScan as LaserScan
    from fcslam.records import Odometry as Odometry
    from fcslam.records import Reason as Reason
    from fcslam.records import ReasonCode as ReasonCode
    from fcslam.records import Sweep as Sweep
    from fcslam.records import Transform as Transform
    from fcslam.records import Veto as Veto
    from fcslam.robot.outbox import WaitingPackets as WaitingPackets
    from fcslam.runs import ClosureRow as ClosureRow
    from fcslam.runs import Join as Join
    from fcslam.runs import LocalizedPoses as LocalizedPoses
    from fcslam.runs import LocalMap as LocalMap
    from fcslam.runs import Metric as Metric
    from fcslam.runs import RobotTrajectory as RobotTrajectory
    from fcslam.runs import Run as Run
    from fcslam.runs import open_run as open_run
    from fcslam.sources import BagOptions as BagOptions
    from fcslam.sources import Fault as Fault
    from fcslam.sources import FaultCount as FaultCount
    from fcslam.sources import Faults as Faults
    from fcslam.sources import ScanRange as ScanRange
    from fcslam.sources import Source as Source
    from fcslam.sources import Survey as Survey
    from fcslam.sources.point_clouds import CloudBand as CloudBand
    from fcslam.wire.keys import Server as Server

__version__ = "0.1.0"

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
        "fcslam.wire.keys": "Server",
    }.items()
    for name in names.split()
}
"""Where each name is that is imported at its first use."""

__all__ = [*sorted([*_LAZY, "__version__", *(name for name in globals() if name.endswith("Error"))])]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'fcslam' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_LAZY[name]), name)
    return value


def __dir__() -> list[str]:
    return __all__
