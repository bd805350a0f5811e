"""What a user may choose where a bag leaves a choice."""

from dataclasses import dataclass

from fcslam.sources.pose import Pose


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Choices for one bag; None: told by the bag itself."""

    scan_topic: str | None = None
    odom_topic: str | None = None
    """A topic of odometry, or one of tf that carries odom -> base."""
    camera_topic: str | None = None
    laser_pose: Pose | None = None
    """``T_base_laser`` in metres and radians, in place of what tf says."""
