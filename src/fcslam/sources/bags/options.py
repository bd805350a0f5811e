"""Options for reading a bag."""

from dataclasses import dataclass

from fcslam.sources.pose import Pose


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Options for one bag; None: chosen automatically."""

    scan_topic: str | None = None
    odom_topic: str | None = None
    """A topic of odometry, or one of tf that carries odom -> base."""
    camera_topic: str | None = None
    laser_pose: Pose | None = None
    """``T_base_laser`` in metres and radians, instead of the transform in tf."""
