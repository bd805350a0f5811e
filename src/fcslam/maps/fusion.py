"""One occupancy map from the keyscans of several robots."""

from collections.abc import Mapping, Sequence

from fcslam.lidar.occupancy import OccupancyConfig, cast, classify
from fcslam.records import FloatArray, Keyscan, LaserModel
from fcslam.runs.map_files import OccupancyMap


def fuse(
    keyscans: Sequence[Keyscan],
    T_map_base: FloatArray,
    lasers: Mapping[str, Sequence[LaserModel]],
    config: OccupancyConfig,
) -> OccupancyMap:
    """Compute the occupancy map of keyscans; their order does not matter.

    Args:
        keyscans: N keyscans of any robots.
        T_map_base: their poses in ``map``, shape (N, 3), metres and radians.
        lasers: the lasers that each robot announced.
        config: the occupancy grid.

    Raises:
        ValueError: the numbers of poses and keyscans or of ranges and beams differ, or a pose is not finite.
        KeyError: a keyscan's robot has no lasers.
    """
    castings = [
        (keyscan.ranges_m, keyscan.laser_model(lasers[keyscan.id.robot]), pose)
        for keyscan, pose in zip(keyscans, T_map_base, strict=True)
    ]
    grid = cast(castings, config)
    return OccupancyMap(classify(grid, config), grid.resolution_m, grid.origin_xy)
