"""One occupancy map from the keyscans of several robots."""

from collections.abc import Mapping, Sequence

from fcslam.lidar.occupancy import OccupancyConfig, cast, classify
from fcslam.records import FloatArray, Keyscan, LaserModel
from fcslam.runs.map_files import OccupancyMap


def fuse(
    keyscans: Sequence[Keyscan], T_map_base: FloatArray, lasers: Mapping[str, LaserModel], config: OccupancyConfig
) -> OccupancyMap:
    """Map of all keyscans at their poses (N, 3); ``lasers`` holds each robot's own. The order does not matter.

    Raises:
        ValueError: poses do not fit the keyscans, ranges do not fit the laser, or a pose is not finite.
        KeyError: a keyscan's robot has no laser.
    """
    castings = [
        (keyscan.ranges_m, lasers[keyscan.id.robot], pose) for keyscan, pose in zip(keyscans, T_map_base, strict=True)
    ]
    grid = cast(castings, config)
    return OccupancyMap(classify(grid, config), grid.resolution_m, grid.origin_xy)
