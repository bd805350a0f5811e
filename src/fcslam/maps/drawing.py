"""The picture of a map, with the trajectories of the robots and closures between them, and that of a closure.

Drawn with OpenCV, which takes a sixth of the time of matplotlib and does not interpolate walls.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.maps import palette
from fcslam.maps.occupancy_map import Cells, Occupancy, OccupancyMap
from fcslam.records import Channel, ClosureStatus, FloatArray, LoopClosure

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

MARGIN_PX: Final = 40
LONG_SIDE_PX: Final = 40 * MARGIN_PX
NARROWEST_PX: Final = 16 * MARGIN_PX
"""Smallest width of the picture, which the legend needs."""
RAY_M: Final = 0.15
"""Known area thinner than this, such as single beams through windows, does not extend the picture."""
FARTHEST_PX: Final = 100_000.0
"""Pixel coordinates are clipped to this, because OpenCV's fixed-point coordinates overflow beyond."""

LINE_HEIGHT_PX: Final = MARGIN_PX
SWATCH_PX: Final = 34
GAP_PX: Final = 14
FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
FONT_SCALE: Final = 0.75
CLOSURES_APART_M: Final = 10.0 * RAY_M
"""Smallest distance between the midpoints of two drawn closures."""
SUBPIXEL_BITS: Final = 4
"""Fractional bits of OpenCV's fixed-point coordinates."""
SIDE_PX: Final = 12 * MARGIN_PX
"""Side of the picture of a closure."""
REACH_M: Final = 10.0 * CLOSURES_APART_M
"""Half of its side, or more for keyscans that are far apart: this remains around each."""
DOT_PX: Final = 2


def _bgr(rgb: int) -> Color:
    return rgb & 255, rgb >> 8 & 255, rgb >> 16


PAPER: Final = _bgr(palette.PAPER)
FLOOR: Final = _bgr(palette.FLOOR)
WALL: Final = _bgr(palette.WALL)
INK: Final = _bgr(palette.INK)
CLOSURE: Final = _bgr(palette.CLOSURES[Channel.LIDAR])
CHANGES: Final = _bgr(palette.APPEARED), _bgr(palette.DISAPPEARED)
_APPEARED, _DISAPPEARED = len(Occupancy), len(Occupancy) + 1
"""Cells of a picture besides ``Occupancy``; in small pictures the highest number of a block is drawn."""


@dataclass(frozen=True, slots=True)
class _Viewport:
    cells: Cells  # row 0 at the lowest y
    corner_xy: FloatArray  # lower left corner in map
    cell_m: float
    cell_px: int
    offset_px: int  # from the left edge of the canvas

    def pixels(self, points: FloatArray) -> FloatArray:
        """Transform points (N, 2+) of ``map`` to pixels (M, 2), whole numbers at centres; drops non-finite points."""
        x, y = ((_finite(points) - self.corner_xy) * (self.cell_px / self.cell_m)).T
        column = self.offset_px + x - 0.5
        row = MARGIN_PX + self.cells.shape[0] * self.cell_px - y - 0.5
        return np.asarray(np.clip(np.stack((column, row), axis=-1), -FARTHEST_PX, FARTHEST_PX))


def map_png(fused: OccupancyMap, trajectories: Mapping[str, FloatArray], closures: Sequence[FloatArray] = ()) -> bytes:
    """Draw the map as a PNG of about 1600 pixels on its long side, cropped to known area and trajectories.

    Each trajectory has shape (N, 2+) in ``map`` and a dot at the first pose. Closures between robots, given by their
    ends (2, 2) in ``map``, are counted, and drawn unless they are too close together.
    """
    view = _view(fused, trajectories.values())
    canvas = _canvas(view)
    colors = {robot: _bgr(color) for robot, color in palette.robot_colors(trajectories).items()}
    ways = [(view.pixels(points), colors[robot]) for robot, points in trajectories.items()]
    for pixels, color in ways:
        _draw_line(canvas, pixels, FLOOR, 5)  # a light outline, for contrast with walls and other lines
        _draw_line(canvas, pixels, color, 2)
    for ends in _spread(closures):
        _draw_line(canvas, view.pixels(ends), CLOSURE, 1)
    for pixels, color in ways:
        _draw_start(canvas, pixels, color)
    labels = list(colors.items())
    if closures:
        labels.append((f"{len(closures)} closure{'s' * (len(closures) > 1)} between robots", CLOSURE))
    return _with_legend(canvas, labels, view)


def picture(
    occupancy: OccupancyMap,
    trajectories: Mapping[str, FloatArray],
    closures: Sequence[LoopClosure],
    keyscans: Mapping[str, FloatArray],
) -> bytes:
    """The map with trajectories (N, 3) by session, and a line for each accepted closure between robots.

    ``keyscans`` are poses (K, 3) by session; closures with an end outside of the map are left out.
    """
    lines = [
        np.array((keyscans[i.robot][i.number, :2], keyscans[j.robot][j.number, :2]))
        for i, j in ((closure.i, closure.j) for closure in closures if closure.status is ClosureStatus.ACCEPTED)
        if i.robot != j.robot and i.robot in keyscans and j.robot in keyscans
    ]
    return map_png(occupancy, trajectories, lines)


def highlighted_png(
    fused: OccupancyMap, appeared: NDArray[np.bool_], disappeared: NDArray[np.bool_], labels: tuple[str, str]
) -> bytes:
    """Draw the map as a PNG of about 1600 pixels on its long side, with two sets of cells in colours.

    The sets are masks (H, W) of the map; ``labels`` are what the legend calls both.
    """
    painted = fused.cells.copy()
    painted[appeared], painted[disappeared] = _APPEARED, _DISAPPEARED
    view = _view(replace(fused, cells=painted), ())
    return _with_legend(_canvas(view), list(zip(labels, CHANGES, strict=True)), view)


def _spread(closures: Sequence[FloatArray]) -> list[FloatArray]:
    """Select the shortest closures with at least ``CLOSURES_APART_M`` between their midpoints.

    A closure is compared with those in the squares around its midpoint, so that many take no longer each than few.
    """
    side_m = CLOSURES_APART_M
    drawn: list[FloatArray] = []
    squares: dict[tuple[int, int], list[tuple[float, float]]] = {}
    finite = [ends for ends in closures if np.isfinite(ends).all()]
    for ends in sorted(finite, key=lambda ends: float(np.hypot(*(ends[1] - ends[0])))):
        x, y = ((ends[0] + ends[1]) / 2.0).tolist()
        column, row = int(x // side_m), int(y // side_m)
        around = ((column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1))
        if all(math.dist((x, y), middle) > side_m for square in around for middle in squares.get(square, ())):
            drawn.append(ends)
            squares.setdefault((column, row), []).append((x, y))
    return drawn


def _view(fused: OccupancyMap, trajectories: Iterable[FloatArray]) -> _Viewport:
    """Crop the map and scale it to whole pixels per cell, or to whole cells per pixel for a large map."""
    low, high = _shown_box(fused, trajectories)
    cells = fused.cells[low[0] : high[0], low[1] : high[1]]
    corner = np.array(fused.origin_xy) + fused.resolution_m * low[::-1]
    ratio = LONG_SIDE_PX / max(cells.shape)
    cells_per_pixel, cell_px = max(1, round(1.0 / ratio)), max(1, round(ratio))
    cells = _shrunk(cells, cells_per_pixel)
    offset = max(MARGIN_PX, (NARROWEST_PX - cells.shape[1] * cell_px) // 2)
    return _Viewport(cells, corner, fused.resolution_m * cells_per_pixel, cell_px, offset)


def _shown_box(fused: OccupancyMap, trajectories: Iterable[FloatArray]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and one past the last (row, column) of known area, without single beams, and of trajectories."""
    shape = fused.cells.shape
    side = max(1, round(RAY_M / fused.resolution_m))
    shown = (fused.cells != Occupancy.UNKNOWN).astype(np.uint8)
    shown = cv2.morphologyEx(shown, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    for points in trajectories:
        columns, rows = np.floor((_finite(points) - fused.origin_xy) / fused.resolution_m).T
        inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
        shown[rows[inside].astype(np.int64), columns[inside].astype(np.int64)] = 1
    if not shown.any():
        return np.zeros(2, np.int64), np.array(shape)
    spans = [np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0)]
    low, high = (np.array([span[end] for span in spans]) for end in (0, -1))
    return np.maximum(low - side, 0), np.minimum(high + side + 1, shape)


def _finite(points: FloatArray) -> FloatArray:
    xy = np.asarray(points, dtype=np.float64)[:, :2]
    return np.asarray(xy[np.isfinite(xy).all(axis=1)])


def _shrunk(cells: Cells, factor: int) -> Cells:
    """Downsample cells (H, W) by a factor: a block with a wall is a wall, one with known cells is known."""
    height, width = cells.shape
    padded = np.pad(cells, ((0, -height % factor), (0, -width % factor)))
    blocks = padded.reshape(padded.shape[0] // factor, factor, -1, factor)
    return np.asarray(blocks.max(axis=(1, 3)))


def _canvas(view: _Viewport) -> Image:
    colors = np.zeros((_DISAPPEARED + 1, 3), np.uint8)
    colors[Occupancy.UNKNOWN], colors[Occupancy.FREE], colors[Occupancy.OCCUPIED] = PAPER, FLOOR, WALL
    colors[_APPEARED], colors[_DISAPPEARED] = CHANGES
    drawn = cv2.resize(
        colors[view.cells[::-1]], None, fx=view.cell_px, fy=view.cell_px, interpolation=cv2.INTER_NEAREST_EXACT
    )
    margins = MARGIN_PX, MARGIN_PX, view.offset_px, view.offset_px
    return np.asarray(cv2.copyMakeBorder(drawn, *margins, cv2.BORDER_CONSTANT, value=PAPER))


def _draw_start(canvas: Image, pixels: FloatArray, color: Color) -> None:
    if len(pixels):
        center = [int(value) for value in _fixed_point(pixels[0])]
        for radius_px, fill in ((10, FLOOR), (7, color)):
            cv2.circle(canvas, center, radius_px << SUBPIXEL_BITS, fill, cv2.FILLED, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_line(canvas: Image, pixels: FloatArray, color: Color, width_px: int) -> None:
    if len(pixels) > 1:
        cv2.polylines(canvas, [_fixed_point(pixels)], False, color, width_px, cv2.LINE_AA, SUBPIXEL_BITS)


def _fixed_point(pixels: FloatArray) -> NDArray[np.int32]:
    return np.rint(pixels * (1 << SUBPIXEL_BITS)).astype(np.int32)


def _with_legend(canvas: Image, labels: list[tuple[str, Color]], view: _Viewport) -> bytes:
    picture = np.vstack((canvas, _legend(labels, canvas.shape[1], view.cell_px / view.cell_m)))
    return bytes(cv2.imencode(".png", picture)[1])


def _legend(labels: list[tuple[str, Color]], width_px: int, pixels_per_m: float) -> Image:
    """Legend of names and colours over several lines, with a scale bar at the right of the first line."""
    length_m = round_length(0.2 * width_px / pixels_per_m)
    bar_px = round(length_m * pixels_per_m)
    right = width_px - MARGIN_PX
    places: list[tuple[int, int]] = []
    left, line, end = MARGIN_PX, 0, right - bar_px - 2 * GAP_PX
    for text, _ in labels:
        wide = SWATCH_PX + GAP_PX + _text_width(text)
        if left + wide > end:
            left, line, end = MARGIN_PX, line + 1, right
        places.append((left, line))
        left += wide + 2 * GAP_PX
    strip = np.full(((line + 2) * LINE_HEIGHT_PX, width_px, 3), PAPER, np.uint8)
    for (text, color), (left, line) in zip(labels, places, strict=True):
        y = line * LINE_HEIGHT_PX + LINE_HEIGHT_PX // 2
        cv2.line(strip, (left, y), (left + SWATCH_PX, y), color, 4, cv2.LINE_AA)
        _write(strip, text, (left + SWATCH_PX + GAP_PX, y + 8))
    _draw_scale(strip, right, bar_px, f"{length_m:g} m")
    return strip


def _draw_scale(strip: Image, right: int, bar_px: int, text: str) -> None:
    y = LINE_HEIGHT_PX // 2
    corners = ((right - bar_px, y - 6), (right - bar_px, y), (right, y), (right, y - 6))
    cv2.polylines(strip, [np.array(corners, np.int32)], False, INK, 2)
    _write(strip, text, (right - (bar_px + _text_width(text)) // 2, y + 28))


def round_length(length_m: float) -> float:
    """Largest number of the form 1, 2 or 5 times a power of ten that does not exceed ``length_m``."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return power * max(factor for factor in (1, 2, 5) if factor == 1 or factor * power <= length_m)


def _write(image: Image, text: str, baseline: tuple[int, int]) -> None:
    cv2.putText(image, text, baseline, FONT, FONT_SCALE, INK, 1, cv2.LINE_AA)


def _text_width(text: str) -> int:
    size: Any = cv2.getTextSize(text, FONT, FONT_SCALE, 1)[0]
    return int(size[0])


def closure_png(
    points: tuple[FloatArray, FloatArray], poses: tuple[FloatArray, FloatArray], colors: tuple[int, int]
) -> bytes:
    """Draw returns of both ends of a closure as a PNG.

    The returns (N, 2) of each end and the poses (3,) of both keyscans are in the base of the first one, in metres and
    radians. The colors are as in ``palette``.
    """
    canvas = np.full((SIDE_PX, SIDE_PX, 3), _bgr(palette.FLOOR), np.uint8)
    centre = (poses[0][:2] + poses[1][:2]) / 2.0
    reach_m = REACH_M + float(np.abs(poses[0][:2] - centre).max())
    for returns, pose, color in zip(points, poses, map(_bgr, colors), strict=True):
        for column, row in _pixels(returns - centre, reach_m):
            cv2.circle(canvas, (int(column), int(row)), DOT_PX, color, cv2.FILLED, cv2.LINE_AA)
        arrow = se2.transform(pose, np.array(((0.0, 0.0), (1.0, 0.0))))
        start, end = _pixels(arrow - centre, reach_m).tolist()
        cv2.arrowedLine(canvas, start, end, _bgr(palette.WALL), 5, cv2.LINE_AA, 0, 0.4)
        cv2.arrowedLine(canvas, start, end, color, 3, cv2.LINE_AA, 0, 0.4)
    return bytes(cv2.imencode(".png", canvas)[1])


def _pixels(points: FloatArray, reach_m: float) -> NDArray[np.int64]:
    inside = points[(np.abs(points) < reach_m).all(axis=1)]
    return np.asarray(np.rint((inside * (1.0, -1.0) + reach_m) * ((SIDE_PX - 1) / (2.0 * reach_m))).astype(np.int64))
