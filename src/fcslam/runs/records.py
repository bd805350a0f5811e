"""What a run folder holds, as frozen records."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fcslam.records import Channel, ClosureStatus, FloatArray


@dataclass(frozen=True, slots=True)
class RobotTrajectory:
    """Where one robot was at every laser scan of its recording, in the scans' order."""

    robot: str
    map_index: int
    stamps: FloatArray
    """Shape (N,), the recording's own stamps."""
    T_map_base: FloatArray
    """Shape (N, 3), in the coordinate frame of map ``map_index``."""

    @property
    def path_length_m(self) -> float:
        """Length of the polygon through the positions."""
        steps = np.diff(self.T_map_base[:, :2], axis=0)
        return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])))


@dataclass(frozen=True, slots=True)
class LocalMap:
    """One robot's own map: what it knew before any other robot's measurements; the origin is its first keyscan."""

    robot: str
    stamps: FloatArray
    """Shape (N,), as in the robot's trajectory."""
    T_local_base: FloatArray
    """Shape (N, 3), at every laser scan."""
    pgm: bytes
    yaml: str
    """For ROS map_server; names the PGM file ``<robot>.pgm``."""


@dataclass(frozen=True, slots=True)
class ClosureRow:
    """One loop closure as closures.csv tells it."""

    robot_i: str
    stamp_i: float
    robot_j: str
    stamp_j: float
    channel: Channel
    similarity: float
    """In [0, 1]."""
    T_i_j: FloatArray
    status: ClosureStatus
    reason: str


@dataclass(frozen=True, slots=True)
class Metric:
    """A named number with its unit."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Run:
    """Everything in a run folder."""

    trajectories: tuple[RobotTrajectory, ...]
    closures: tuple[ClosureRow, ...] = ()
    metrics: tuple[Metric, ...] = ()
    config_yaml: str = ""
    pose_graph_g2o: str = ""
    map_files: Mapping[str, bytes] = field(default_factory=dict)
    """File name to content: map.pgm, map.yaml, map.png, map_1.pgm ..."""
    local_maps: tuple[LocalMap, ...] = ()
    """Of every robot, in the order of the trajectories; or none, and the folder has no ``local``."""
