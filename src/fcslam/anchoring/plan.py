"""A floor plan as a submap: the surfaces of its lines, to match scans with."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import cv2
import numpy as np

from fcslam.lidar.field import SurfelField
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import FREE_CELL_M, Submap
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import FloatArray, frozen

UNITS_M: Final = ((0.001, "millimetres"), (0.01, "centimetres"), (0.0254, "inches"), (0.3048, "feet"), (1.0, "metres"))
"""Units of drawings, in metres."""
NORMAL_SIGMA_PX: Final = 2.0
"""Blur of the drawing whose gradient gives the normals."""
_HERE: Final = np.zeros(3)


@dataclass(frozen=True, eq=False)
class BuildingPlan:
    """A floor plan; all coordinates are those of the plan."""

    drawing: OccupancyMap
    """Its lines are occupied, the other cells are free."""
    unit_m: float | None = None
    """Metres per pixel of a picture, or per unit of a DXF drawing; None: the plan has its own scale."""
    is_picture: bool = True
    """Whether the plan has pixels."""
    thickness_m: float = 0.0
    """By how much the sides of walls lie farther from their middle than they are drawn."""

    @property
    def half_width_m(self) -> float:
        """Half of the usual width of its lines."""
        inside = cv2.distanceTransform((self.drawing.cells == Occupancy.OCCUPIED).astype(np.uint8), cv2.DIST_L2, 5)
        ridge = inside[(inside > 0.0) & (inside >= cv2.dilate(inside, np.ones((3, 3), np.uint8)))]
        return (float(np.median(ridge)) - 0.5) * self.drawing.resolution_m if len(ridge) else 0.0

    @property
    def sides_m(self) -> tuple[float, float]:
        """The shorter and the longer side of the plan."""
        shorter, longer = sides_m(np.argwhere(self.drawing.cells == Occupancy.OCCUPIED).astype(np.float64))
        return shorter * self.drawing.resolution_m, longer * self.drawing.resolution_m

    def mirrored(self) -> "BuildingPlan":
        """The plan seen from below."""
        return replace(self, drawing=replace(self.drawing, cells=frozen(self.drawing.cells[:, ::-1], np.uint8)))

    def scaled(self, factor: float) -> "BuildingPlan":
        """The plan in another size."""
        x, y = self.drawing.origin_xy
        drawing = replace(
            self.drawing, resolution_m=factor * self.drawing.resolution_m, origin_xy=(factor * x, factor * y)
        )
        return replace(self, drawing=drawing)

    @cached_property
    def submap(self) -> Submap:
        """Surfaces on both sides of every line. There is no free space, as a plan leaves out furniture."""
        edges = _edges(self.drawing)
        edges = replace(edges, points=edges.points + self.thickness_m * edges.normals)
        field = SurfelField(edges.points.mean(axis=0))
        field.insert(edges, _HERE)
        corner = edges.points.min(axis=0) - FREE_CELL_M
        columns, rows = np.ceil((edges.points.max(axis=0) - corner) / FREE_CELL_M).astype(np.int64) + 1
        return Submap.of(field, np.zeros((rows, columns), bool), corner)


def unit_of(unit_m: float) -> str:
    """The name of the unit of a drawing; empty if it has none, as a picture."""
    return next((name for usual_m, name in UNITS_M if abs(unit_m - usual_m) < 1e-6), "")


def sides_m(points: FloatArray) -> tuple[float, float]:
    """The shorter and the longer side of the smallest rectangle around points, shape (N, 2)."""
    _, sides, _ = cv2.minAreaRect(points.astype(np.float32))
    return min(sides), max(sides)


def _edges(drawing: OccupancyMap) -> PointScan:
    """The middle of each side between a line's cell and a blank one, with a normal towards the blank."""
    lines = np.pad(drawing.cells == Occupancy.OCCUPIED, 1)
    blurred = cv2.GaussianBlur(lines.astype(np.float32), (0, 0), NORMAL_SIGMA_PX)
    slope = np.stack((cv2.Sobel(blurred, cv2.CV_32F, 1, 0), cv2.Sobel(blurred, cv2.CV_32F, 0, 1)), axis=-1)
    points, normals = [], []
    for row_step, column_step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        step = np.array((column_step, row_step), dtype=np.float64)
        blank = np.roll(~lines, (-row_step, -column_step), axis=(0, 1))
        rows, columns = np.nonzero(lines & blank)
        normal = -(slope[rows, columns] + slope[rows + row_step, columns + column_step]).astype(np.float64)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), step)
        points.append(np.column_stack((columns, rows)) - 0.5 + 0.5 * step)
        normals.append(np.where((normal @ step > 0.0)[:, None], normal, step))
    xy: FloatArray = np.concatenate(points) * drawing.resolution_m + drawing.origin_xy
    return PointScan(xy, np.concatenate(normals), np.zeros(len(xy), bool), np.zeros(2))
