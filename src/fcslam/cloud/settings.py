"""What the cloud is set to; a mission keeps it, so that it can be made again from its packets."""

from pydantic import Field

from fcslam.cloud.fleet import FleetConfig
from fcslam.config import Settings
from fcslam.lidar.occupancy import OccupancyConfig


class CloudConfig(Settings):
    """The cloud's part of a configuration."""

    seed: int = Field(default=0, ge=0, description="of the one random generator; the same seed gives the same run")
    fleet: FleetConfig = Field(default=FleetConfig(), description="what runs in the cloud")
    map: OccupancyConfig = Field(default=OccupancyConfig(), description="the occupancy grid")
