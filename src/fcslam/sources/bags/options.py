"""Options for reading a bag."""

from dataclasses import dataclass, field
from typing import Final

from fcslam.sources.point_clouds import CloudBand
from fcslam.sources.pose import Pose
from fcslam.sources.returns import FloorLine

NO_ODOMETRY: Final = "none"
"""In place of a topic of odometry: none is read."""


GivenPose = Pose | tuple[float, float, float, bool]
"""Pose of a laser on the floor plan of its robot, and whether it is upside down."""


@dataclass(frozen=True, slots=True)
class BagCorrection:
    """Corrections of the messages of a bag, from the motion in it."""

    odometry_delay_s: float = 0.0
    """Stamps of the odometry are this much later than those of scans made at the same time."""
    sweep: tuple[float, float] | None = None
    """Times of the first and the last beam after the stamp of a scan, beams counter-clockwise; equal: all beams are
    measured at once. None: as the messages say."""
    mounting: Pose = (0.0, 0.0, 0.0)
    """``C`` of the true ``T_base_laser = C T_base_laser``."""
    upside_down: bool = False
    """Whether the laser is upside down where the bag says that it is upright, or the other way round."""
    floors: tuple[FloorLine | None, ...] = ()
    """For each laser, where it sees the floor, which is left out. Empty: none does."""


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Options for one bag; None: chosen automatically."""

    scan_topics: tuple[str, ...] = ()
    """One for each laser; empty: one is chosen automatically."""
    odom_topic: str | None = None
    """A topic of odometry, or one of tf that carries odom -> base, or ``NO_ODOMETRY``."""
    camera_topic: str | None = None
    laser_poses: tuple[GivenPose, ...] = ()
    """``T_base_laser`` of each laser in metres and radians, instead of the transforms in tf; with True: upside down."""
    odom_frame: str | None = None
    base_frame: str | None = None
    robot: str | None = None
    cloud_band: CloudBand = field(default_factory=CloudBand)
    correction: BagCorrection = field(default_factory=BagCorrection)
    in_3d: bool = False
    """Whether point clouds are read whole, and not a band of their heights as a 2D scan."""
