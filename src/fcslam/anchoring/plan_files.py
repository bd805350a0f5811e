"""Reads floor plans: a drawing as PNG, a map of ROS, or a DXF drawing. Each becomes a grid of lines and blank area."""

import math
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.anchoring.plan import UNITS_M, BuildingPlan
from fcslam.errors import SourceError
from fcslam.lidar.field import WIDEST_M
from fcslam.maps.drawing import SUBPIXEL_BITS
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.maps.ros_map import decoded_image, read_ros_map
from fcslam.records import FloatArray, frozen
from fcslam.untrusted import read_bytes

DXF_CELL_M: Final = 0.02
"""Side of a cell in which a DXF drawing is drawn."""
MOST_PIXELS: Final = 1 << 27
"""Largest number of pixels of a plan; 230 m by 230 m in pixels of 2 cm."""
TEXT_M: Final = 0.5
"""Lines that are connected and no longer and no higher than this are text and symbols."""
WALL_M: Final = 0.4
"""Two lines this close together are the sides of one wall."""
COLOUR_STEP: Final = 16
"""Colours in steps of this size are one colour where the background is found."""
FAINTEST: Final = 2 * COLOUR_STEP
"""Least difference of the darkest lines from the background, in grey levels of 255."""
FAINT_SHARE: Final = 0.4
"""Lines differ from the background by at least this share of the difference of the darkest ones: fills are fainter."""
_LEAST_BUILDING_M: Final = 5.0
"""A drawing of a smaller building has another unit."""
_FLATNESS_M: Final = 0.25 * DXF_CELL_M
"""Largest distance of an arc from the line segments that replace it."""
_NOT_WALLS: Final = ("TEXT", "MTEXT", "ATTRIB", "ATTDEF", "DIMENSION", "LEADER", "MULTILEADER", "IMAGE", "WIPEOUT")
"""Kinds of entities of a DXF drawing that show no walls."""


def read_plan(path: Path, scale: float | None = None) -> BuildingPlan:
    """Read a floor plan: occupied cells are its lines, the others are free. Its coordinates are those of the plan.

    It is a PNG (or JPEG, BMP, TIFF) drawing, whose origin is its lower left corner, the YAML file of a ROS map, or a
    DXF drawing. ``scale``: metres per pixel of a drawing, or per unit of a DXF file that does not name its unit.
    """
    if scale is not None and not 0.0 < scale < math.inf:
        raise SourceError(f"--plan-scale {scale:g}: give metres per pixel, above 0")
    try:
        match path.suffix.lower():
            case ".yaml" | ".yml":
                plan, unit_m = _ros_plan(path, scale), None
            case ".dxf":
                plan, unit_m = _dxf_plan(path, scale)
            case _:
                plan, unit_m = _drawn_plan(path, scale), scale
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error}); give the file of a plan") from error
    height, width = plan.cells.shape
    if max(height, width) * plan.resolution_m > WIDEST_M:
        raise SourceError(
            f"{path}: the plan is {width * plan.resolution_m:.0f} m by {height * plan.resolution_m:.0f} m, "
            f"{WIDEST_M:.0f} m at most are possible; check the scale, or crop the plan"
        )
    cells = _solid(_without_text(plan.cells, plan.resolution_m), plan.resolution_m)
    if not (cells == Occupancy.OCCUPIED).any():
        raise SourceError(f"{path}: the plan shows no lines longer than {TEXT_M:g} m; check the scale and the colours")
    return BuildingPlan(
        OccupancyMap(frozen(cells, np.uint8), plan.resolution_m, plan.origin_xy), unit_m, path.suffix.lower() != ".dxf"
    )


def _ros_plan(path: Path, scale: float | None) -> OccupancyMap:
    if scale is not None:
        raise SourceError(f"{path}: a ROS map has its own resolution; leave --plan-scale out")
    plan = read_ros_map(path)
    cells = np.where(plan.cells == Occupancy.OCCUPIED, plan.cells, Occupancy.FREE).astype(np.uint8)
    return OccupancyMap(cells, plan.resolution_m, plan.origin_xy)


def _drawn_plan(path: Path, scale: float | None) -> OccupancyMap:
    pixels = decoded_image(read_bytes(path))
    if pixels is None:
        raise SourceError(f"{path}: cannot be read as a picture; save the plan as PNG, DXF or a ROS map (YAML)")
    if scale is None:
        raise SourceError(f"{path}: a picture has no scale; give metres per pixel, as in --plan-scale 0.02")
    if pixels.shape[0] * pixels.shape[1] > MOST_PIXELS:
        raise SourceError(f"{path}: has {pixels.shape[1]} x {pixels.shape[0]} pixels; make it smaller or crop it")
    cells = np.where(_lines(_colours(pixels)), Occupancy.OCCUPIED, Occupancy.FREE).astype(np.uint8)
    return OccupancyMap(cells[::-1], scale, (0.0, 0.0))


def _colours(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Eight bits per colour, shape (H, W, 3), on white paper."""
    levels = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1
    if levels != 255:
        pixels = np.clip(pixels.astype(np.float32) * (255.0 / levels), 0.0, 255.0).astype(np.uint8)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 4:
        opaque = pixels[..., 3:].astype(np.float32) / 255.0
        pixels = np.round(pixels[..., :3] * opaque + 255.0 * (1.0 - opaque)).astype(np.uint8)
    return np.asarray(pixels[..., :3], np.uint8)


def _lines(colours: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels that clearly differ from the background, the most frequent colour; shape (H, W)."""
    rough = (colours // COLOUR_STEP).astype(np.int32)
    numbers = (rough[..., 0] * 256 + rough[..., 1]) * 256 + rough[..., 2]
    known, counts = np.unique(numbers, return_counts=True)
    background = np.median(colours[numbers == known[np.argmax(counts)]], axis=0)
    difference = np.abs(colours.astype(np.float32) - background.astype(np.float32)).max(axis=2)
    darkest = float(difference.max())
    return np.asarray(difference >= max(FAINT_SHARE * darkest, FAINTEST))


def _without_text(cells: NDArray[np.uint8], cell_m: float) -> NDArray[np.uint8]:
    """The cells without connected lines that are too small for walls."""
    lines = (cells == Occupancy.OCCUPIED).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(lines, connectivity=8)
    size_m = cell_m * stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    small = size_m <= TEXT_M
    small[0] = True
    return np.where(small[labels], Occupancy.FREE, Occupancy.OCCUPIED).astype(np.uint8)


def _solid(cells: NDArray[np.uint8], cell_m: float) -> NDArray[np.uint8]:
    """The cells with walls filled that are drawn as two lines, hatched or not."""
    side = 2 * int(0.5 * WALL_M / cell_m) + 1  # an even one would shift the walls
    margin = side + 1
    padded = cv2.copyMakeBorder(cells, *4 * (margin,), cv2.BORDER_CONSTANT, value=int(Occupancy.FREE))
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
    return np.asarray(closed[margin:-margin, margin:-margin], np.uint8)


def _dxf_plan(path: Path, scale: float | None) -> tuple[OccupancyMap, float]:
    try:
        import ezdxf
        from ezdxf import units
        from ezdxf.enums import InsertUnits
    except ImportError as error:
        raise SourceError(f"{path}: reading DXF needs ezdxf; install it: pip install 'fcslam[plans]'") from error
    try:
        drawing: Any = ezdxf.readfile(path)
    except OSError:
        raise
    except Exception as error:  # of any kind if the file is damaged
        raise SourceError(f"{path}: cannot be read as a DXF drawing ({error}); save it as DXF again") from error
    try:
        unit_m = scale or float(units.conversion_factor(InsertUnits(drawing.units), InsertUnits.Meters))
    except (TypeError, ValueError) as error:  # it has none, or one that is not known
        raise SourceError(
            f"{path}: the drawing does not name its unit; give metres per unit: --plan-scale 0.001 for millimetres"
        ) from error
    lines = [unit_m * line for line in _dxf_lines(drawing, _FLATNESS_M / unit_m)]
    if not lines:
        raise SourceError(f"{path}: the drawing shows no lines in its model space")
    points = np.concatenate(lines)
    low = np.floor(points.min(axis=0) - 1.0)
    size_m = points.max(axis=0) + 1.0 - low
    width, height = np.ptp(points, axis=0).tolist()
    if max(width, height) <= TEXT_M or size_m.max() > WIDEST_M:
        others = [
            f"{width / unit_m * other_m:.1f} m by {height / unit_m * other_m:.1f} m if it is drawn in {name}: "
            f"--plan-scale {other_m:g}"
            for other_m, name in UNITS_M
            if _LEAST_BUILDING_M < max(width, height) / unit_m * other_m < WIDEST_M
        ]
        raise SourceError(
            f"{path}: the drawing is {width:.3f} m by {height:.3f} m by its unit, {WIDEST_M:.0f} m at most are possible"
            f"; {'; '.join([*others, 'or delete what lies far outside'])}"
        )
    cell_m = DXF_CELL_M * max(1.0, math.ceil(math.sqrt(size_m.prod() / MOST_PIXELS) / DXF_CELL_M))
    width, height = np.ceil(size_m / cell_m).astype(int).tolist()
    cells = np.full((height, width), Occupancy.FREE, np.uint8)
    for line in lines:
        corners = np.round(((line - low) / cell_m - 0.5) * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.polylines(cells, [corners], False, int(Occupancy.OCCUPIED), 1, cv2.LINE_8, SUBPIXEL_BITS)
    return OccupancyMap(cells, cell_m, (float(low[0]), float(low[1]))), unit_m


def _dxf_lines(drawing: Any, flatness: float) -> list[FloatArray]:
    """The visible lines of a drawing as polylines, shape (N, 2) each, in its units."""
    from ezdxf import path as paths
    from ezdxf.disassemble import recursive_decompose

    hidden = {layer.dxf.name.lower() for layer in drawing.layers if layer.is_off() or layer.is_frozen()}
    shown = (entity for entity in drawing.modelspace() if entity.dxftype() not in _NOT_WALLS)
    lines: list[FloatArray] = []
    entity: Any
    for entity in recursive_decompose(shown):
        if entity.dxftype() in _NOT_WALLS or entity.dxf.get("layer", "0").lower() in hidden:
            continue
        try:
            found = paths.from_hatch(entity) if entity.dxftype() == "HATCH" else [paths.make_path(entity)]
            for path in found:
                corners = np.array([(point.x, point.y) for point in path.flattening(flatness)])
                if len(corners) > 1 and np.isfinite(corners).all():
                    lines.append(corners)
        except Exception:  # of any kind if an entity is not a line, or has no length
            continue
    return lines
