"""Options for reading a bag."""

from dataclasses import dataclass
from typing import Final

from fcslam.sources.pose import Pose

NO_ODOMETRY: Final = "none"
"""In place of a topic of odometry: none is read."""


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Options for one bag; None: chosen automatically."""

    scan_topics: tuple[str, ...] = ()
    """One for each laser; empty: one is chosen automatically."""
    odom_topic: str | None = None
    """A topic of odometry, or one of tf that carries odom -> base, or ``NO_ODOMETRY``."""
    camera_topic: str | None = None
    laser_poses: tuple[Pose, ...] = ()
    """``T_base_laser`` of each laser in metres and radians, instead of the transforms in tf."""
