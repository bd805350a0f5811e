"""What the cloud is set to; a mission keeps it, so that it can be made again from its packets."""

from pydantic import Field

from fcslam.cloud.fusion_strategy import FusionStrategy
from fcslam.config import Settings
from fcslam.graph.consistency import ConsistencySettings
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.places.matcher import MatcherConfig


class FleetConfig(Settings):
    """The cloud's part."""

    join_maps: bool = Field(default=True, description="look for places that several robots saw")
    fusion: FusionStrategy = Field(
        default=FusionStrategy.JOINT,
        description="joint: one robust graph; two_point, n_point: rigid maps laid on one another by matched points",
    )
    sight_m: float = Field(default=6.0, gt=0, description="in a joint map, places this near are compared")
    near_visits: int = Field(
        default=2, ge=0, description="so many visits of each robot, in other sessions, are compared with one place"
    )
    surprise_m: float = Field(default=0.5, gt=0, description="a closure this far off the joint map needs a cluster")
    surprise_rad: float = Field(default=0.1, gt=0, description="or turned this much")
    solve_every: int = Field(default=40, gt=0, description="closures between two quick solves")
    submaps_kept: int = Field(default=300, gt=1, description="submaps held ready for comparison; others are rebuilt")
    matcher: MatcherConfig = Field(default=MatcherConfig(), description="place matching")
    consistency: ConsistencySettings = Field(default=ConsistencySettings(), description="pairwise consistency")


class CloudConfig(Settings):
    """The cloud's part of a configuration."""

    seed: int = Field(default=0, ge=0, description="of the one random generator; the same seed gives the same run")
    fleet: FleetConfig = Field(default=FleetConfig(), description="what runs in the cloud")
    map: OccupancyConfig = Field(default=OccupancyConfig(), description="the occupancy grid")
