"""One occupancy map from the keyscans of several robots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fcslam.lidar.occupancy import OccupancyConfig, OccupancyGrid, cast, classify
from fcslam.records import FloatArray, Keyscan, LaserModel
from fcslam.runs.map_files import Cells


@dataclass(frozen=True, slots=True)
class FusedMap:
    """The map of robots whose poses are known in one ``map``."""

    grid: OccupancyGrid
    cells: Cells
    """``Occupancy`` of every cell, shape (H, W), row 0 at the lowest y."""

    @property
    def resolution_m(self) -> float:
        """Side of a cell."""
        return self.grid.resolution_m

    @property
    def origin_xy(self) -> tuple[float, float]:
        """Lower left corner of cell (0, 0) in ``map``."""
        return self.grid.origin_xy


def fuse(
    keyscans: Sequence[Keyscan], T_map_base: FloatArray, lasers: Mapping[str, LaserModel], config: OccupancyConfig
) -> FusedMap:
    """Map of all keyscans at their poses (N, 3); ``lasers`` holds each robot's own. The order does not matter.

    Raises:
        ValueError: poses do not fit the keyscans, ranges do not fit the laser, or a pose is not finite.
        KeyError: a keyscan's robot has no laser.
    """
    castings = [
        (keyscan.ranges_m, lasers[keyscan.id.robot], pose) for keyscan, pose in zip(keyscans, T_map_base, strict=True)
    ]
    grid = cast(castings, config)
    return FusedMap(grid, classify(grid, config))
