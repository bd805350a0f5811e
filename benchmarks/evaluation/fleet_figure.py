"""The figure of a fleet's run, as figure 5 of FC-SLAM: local maps, matched places, the fused map, the building.

All charts share one axes in pixels, y upwards, so that lines can connect them.
"""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening

from fcslam.errors import writing
from fcslam.geometry import se2
from fcslam.maps.drawing import round_length
from fcslam.maps.palette import CLOSURES, FLOOR, INK, PAPER, WALL, robot_colors
from fcslam.metrics.grid import LabelledGrid
from fcslam.records import Channel, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

RAY_M: Final = 0.5
"""Known area thinner than this, such as single beams through doors, does not extend a chart. Also its margin."""
IDENTITY: Final = (0.0, 0.0, 0.0)
WIDTH_PX: Final = 2000
DPI: Final = 200
MARGIN_PX: Final = 60
GAP_PX: Final = 80
TITLE_PX: Final = 130
NAME_PX: Final = 70
LEGEND_PX: Final = 120
SCALE_PX: Final = 60
HIGHEST_PX: Final = 850
"""Largest height of a chart."""
SHADES: Final = 128
"""Colours of the PNG. The file is a quarter of the size without a visible difference."""
FINE_PX: Final = 2.5
"""Walls of cells smaller than this are drawn one cell thicker."""
MATCHES_DRAWN: Final = 15
"""Most accepted matches of one channel, shared by all pairs of robots; at least one for each pair."""
BOW: Final = 0.15
"""Rise of a line that crosses a chart, as a share of its length."""
TITLE_PT, TEXT_PT = 12.0, 9.5
SENSORS: Final = {Channel.LIDAR: "LiDAR", Channel.CAMERA: "camera"}


class MatchedPlaces(NamedTuple):
    """A verified closure between two robots: the position of each in its own map, shape (2,), metres."""

    robot_i: str
    xy_i: FloatArray
    robot_j: str
    xy_j: FloatArray
    channel: Channel
    accepted: bool
    """Whether the joint map uses it."""


@dataclass(frozen=True, slots=True)
class Chart:
    """A map and the trajectories of robots in it."""

    grid: LabelledGrid
    trajectories: Mapping[str, FloatArray]
    """Each robot's poses or points in the map's coordinate frame, shape (N, 2+)."""
    T_chart_map: tuple[float, float, float] = IDENTITY
    """Pose of the map on the chart: x, y in metres, theta in radians."""

    def place(self, points: FloatArray) -> FloatArray:
        """Transform points (N, 2+) of the map to the chart, metres, shape (N, 2)."""
        return np.asarray(se2.transform(self.T_chart_map, np.asarray(points, dtype=np.float64)[:, :2]))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower left and upper right corner (2,), metres on the chart, of known area and trajectories."""
        side = max(1, round(RAY_M / self.grid.resolution_m))
        known = binary_opening(self.grid.free | self.grid.occupied, np.ones((side, side), np.bool_))
        placed = np.concatenate([self.place(part) for part in (self.grid.centres(known), *self.trajectories.values())])
        if not len(placed):
            return np.zeros(2), np.ones(2)
        return placed.min(axis=0) - RAY_M, placed.max(axis=0) + RAY_M


@dataclass(frozen=True, slots=True)
class FleetCharts:
    """The content of the figure of a fleet."""

    local: Mapping[str, Chart]
    """The map of each robot by its own measurements, in its own frame."""
    fused: Chart
    """The map of most robots, aligned with the building."""
    building: Chart
    """The ground truth."""
    matches: Sequence[MatchedPlaces]


def spread(matches: Sequence[MatchedPlaces], most: int) -> list[MatchedPlaces]:
    """Select up to ``most`` matches of each channel and pair of robots, as far apart as possible."""
    groups: dict[tuple[str, str, Channel], list[MatchedPlaces]] = {}
    for match in matches:
        groups.setdefault((match.robot_i, match.robot_j, match.channel), []).append(match)
    return [match for group in groups.values() for match in _farthest_first(group, most)]


def _farthest_first(matches: Sequence[MatchedPlaces], most: int) -> list[MatchedPlaces]:
    """Farthest point sampling: the first match, then always the one whose ends lie farthest from all chosen ones."""
    ends = np.array([(*match.xy_i, *match.xy_j) for match in matches])
    chosen = [0]
    gaps = np.linalg.norm(ends - ends[0], axis=1)
    while len(chosen) < min(most, len(matches)):
        chosen.append(int(np.argmax(gaps)))
        gaps = np.minimum(gaps, np.linalg.norm(ends - ends[chosen[-1]], axis=1))
    return [matches[k] for k in chosen]


@dataclass(frozen=True, slots=True)
class _Panel:
    """A chart at its position on the sheet."""

    chart: Chart
    low: FloatArray
    """Lower left corner of the shown area, metres on the chart, shape (2,)."""
    size_m: FloatArray
    corner_px: FloatArray
    """The same corner on the sheet, pixels, shape (2,)."""
    scale: float
    """Pixels per metre."""

    def pixels(self, points: FloatArray) -> FloatArray:
        """Transform points (N, 2+) of the map to pixels on the sheet, shape (N, 2)."""
        return np.asarray(self.corner_px + self.scale * (self.chart.place(points) - self.low))

    @property
    def head_px(self) -> FloatArray:
        """Middle of the upper edge, pixels, shape (2,)."""
        return np.asarray(self.corner_px + self.scale * self.size_m * (0.5, 1.0))


def write_figure(charts: FleetCharts, path: Path) -> None:
    """Write the figure as a PNG file, 2000 pixels wide."""
    from PIL import Image

    drawn = io.BytesIO()
    draw_figure(charts).savefig(drawn, format="png")
    with writing(path, "choose another place"):
        Image.open(drawn).convert("RGB").quantize(SHADES, dither=Image.Dither.NONE).save(path, "PNG", optimize=True)


def draw_figure(charts: FleetCharts) -> "Figure":
    """Draw the figure; the lines of accepted matches have the gid ``match``, others ``unused``."""
    lower = _row((charts.fused, charts.building), MARGIN_PX + SCALE_PX)
    legend_px = _top(lower) + TITLE_PX
    upper = _row(tuple(charts.local.values()), legend_px + LEGEND_PX + NAME_PX)
    local = dict(zip(charts.local, upper, strict=True))
    lines = [(match.channel, _line(match, local)) for match in _chosen(charts)]
    unused = [_line(match, local) for match in charts.matches if not match.accepted]
    titles_px = max(_top(upper), *(line[:, 1].max() for line in (*unused, *(line for _, line in lines))), 0.0)
    figure, axes = _sheet(titles_px + TITLE_PX)
    colors = {robot: _hex(color) for robot, color in robot_colors(charts.local).items()}
    for panel in (*upper, *lower):
        _draw_chart(axes, panel, colors)
    for line in unused:
        axes.plot(*line.T, color=_hex(INK), linewidth=0.4, alpha=0.4, gid="unused")
    for channel, line in lines:
        color = _hex(CLOSURES[channel])
        axes.plot(*line.T, color=color, linewidth=0.9, alpha=0.85, gid="match")
        axes.plot(*line[[0, -1]].T, "o", color=color, markersize=2.5)
    for robot, panel in local.items():
        below = panel.corner_px[1] - 0.6 * NAME_PX
        _write(axes, panel.head_px[0], below, robot, color=colors[robot], weight="bold", ha="center")
    _draw_titles(axes, titles_px, lower, len(local))
    _draw_legend(axes, legend_px + 0.5 * LEGEND_PX, charts.matches)
    _draw_scale(axes, legend_px + 0.5 * LEGEND_PX, upper[0].scale)
    _draw_scale(axes, MARGIN_PX, lower[0].scale)
    return figure


def _chosen(charts: FleetCharts) -> list[MatchedPlaces]:
    pairs = math.comb(len(charts.local), 2)
    accepted = [match for match in charts.matches if match.accepted]
    return spread(accepted, max(1, MATCHES_DRAWN // max(1, pairs)))


def _line(match: MatchedPlaces, local: Mapping[str, _Panel]) -> FloatArray:
    """Line between the two ends, pixels, shape (N, 2); it is an arc if other charts lie between."""
    order = list(local)
    start, end = (local[robot].pixels(xy[None])[0] for robot, xy in (match[:2], match[2:4]))
    share = np.linspace(0.0, 1.0, 40)[:, None]
    line = start + share * (end - start)
    if abs(order.index(match.robot_i) - order.index(match.robot_j)) > 1:
        line[:, 1:] += 4.0 * share * (1.0 - share) * BOW * np.linalg.norm(end - start)
    return np.asarray(line)


def _row(charts: Sequence[Chart], bottom_px: float) -> list[_Panel]:
    """Place charts side by side at one scale over the sheet's width."""
    boxes = [chart.bounds() for chart in charts]
    sizes = np.array([high - low for low, high in boxes])
    width_m, height_m = sizes[:, 0].sum(), sizes[:, 1].max()
    room = WIDTH_PX - 2 * MARGIN_PX - GAP_PX * (len(charts) - 1)
    scale = float(min(room / width_m, HIGHEST_PX / height_m))
    spare = (room - scale * width_m) / (len(charts) + 1)
    left, panels = MARGIN_PX + spare, []
    for chart, (low, _), size in zip(charts, boxes, sizes, strict=True):
        corner = np.array((left, bottom_px + 0.5 * scale * (height_m - size[1])))
        panels.append(_Panel(chart, low, size, corner, scale))
        left += scale * size[0] + GAP_PX + spare
    return panels


def _top(row: Sequence[_Panel]) -> float:
    return max(float(panel.head_px[1]) for panel in row)


def _sheet(height_px: float) -> "tuple[Figure, Axes]":
    """A figure and its only axes, in pixels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, facecolor=_hex(PAPER))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, WIDTH_PX), ylim=(0, height_px), autoscale_on=False)
    axes.set_axis_off()
    return figure, axes


def _draw_chart(axes: "Axes", panel: _Panel, colors: Mapping[str, str]) -> None:
    """Draw the map, and every trajectory with a dot at its start."""
    _draw_grid(axes, panel)
    lines = [(panel.pixels(poses), colors[robot]) for robot, poses in panel.chart.trajectories.items()]
    for pixels, color in lines:
        axes.plot(*pixels.T, color=_hex(FLOOR), linewidth=2.2)
        axes.plot(*pixels.T, color=color, linewidth=1.2)
    for pixels, color in lines:
        axes.plot(*pixels[:1].T, "o", color=color, markersize=6.0, markeredgecolor=_hex(FLOOR), markeredgewidth=1.2)


def _draw_grid(axes: "Axes", panel: _Panel) -> None:
    """Draw the grid at its pose, clipped to the panel; unknown cells are transparent."""
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    grid = panel.chart.grid
    height, width = grid.free.shape
    in_grid = grid.resolution_m * np.array(((0, 0), (width, 0), (0, height)))
    corner, right, upper = panel.pixels(se2.transform(grid.T_frame_grid, in_grid))
    turned = Affine2D.from_values(*(right - corner), *(upper - corner), *corner)
    image = axes.imshow(
        _colored(grid, panel.scale),
        origin="lower",
        extent=(0, 1, 0, 1),
        transform=turned + axes.transData,
        aspect="auto",
        interpolation="bilinear",
    )
    box = panel.scale * panel.size_m
    image.set_clip_path(Rectangle((panel.corner_px[0], panel.corner_px[1]), box[0], box[1], transform=axes.transData))


def _colored(grid: LabelledGrid, scale: float) -> "NDArray[np.uint8]":
    """RGBA of every cell, shape (H, W, 4)."""
    fine = scale * grid.resolution_m < FINE_PX
    image = np.empty((*grid.free.shape, 4), np.uint8)
    # transparent paper, not black: interpolation would draw a dark edge around walls
    image[:] = (*_rgb(PAPER), 0)
    image[grid.free] = (*_rgb(FLOOR), 255)
    image[binary_dilation(grid.occupied, np.ones((2, 2), np.bool_)) if fine else grid.occupied] = (*_rgb(WALL), 255)
    return image


def _draw_titles(axes: "Axes", upper_px: float, lower: Sequence[_Panel], robots: int) -> None:
    fused, building = lower
    joined = f"{len(fused.chart.trajectories)} of {robots} robots in one coordinate frame"
    above = "no robot knows where the others are; a line is a place that two of them saw"
    _draw_title(axes, 0.5 * WIDTH_PX, upper_px, "Each robot's own map", above)
    _draw_title(axes, fused.head_px[0], _top(lower), "The fused map", joined)
    _draw_title(axes, building.head_px[0], _top(lower), "The building", "and where the robots really drove")


def _draw_title(axes: "Axes", x: float, bottom_px: float, title: str, words: str) -> None:
    _write(axes, x, bottom_px + 0.66 * TITLE_PX, title, fontsize=TITLE_PT, weight="bold", ha="center")
    _write(axes, x, bottom_px + 0.30 * TITLE_PX, words, ha="center")


def _draw_legend(axes: "Axes", y: float, matches: Sequence[MatchedPlaces]) -> None:
    """At the left: the colour and the number of accepted closures of each channel, and the number of the others."""
    left = float(MARGIN_PX)
    for channel, sensor in SENSORS.items():
        if count := sum(match.channel is channel and match.accepted for match in matches):
            axes.plot((left, left + 60), (y, y), "o-", color=_hex(CLOSURES[channel]), linewidth=1.6, markersize=3.5)
            text = _write(axes, left + 80, y, f"recognised by {sensor}: {count} closure{'s' * (count > 1)}")
            left = text.get_window_extent().x1 + 60
    if count := sum(not match.accepted for match in matches):
        axes.plot((left, left + 60), (y, y), color=_hex(INK), linewidth=0.8, alpha=0.6)
        _write(axes, left + 80, y, f"matched, not accepted: {count}")


def _draw_scale(axes: "Axes", y: float, scale: float) -> None:
    """Draw a scale bar at the right."""
    length_m = round_length(0.15 * WIDTH_PX / scale)
    right = WIDTH_PX - MARGIN_PX
    left = right - length_m * scale
    axes.plot((left, left, right, right), (y + 12, y, y, y + 12), color=_hex(INK), linewidth=1.0)
    _write(axes, 0.5 * (left + right), y - 24, f"{length_m:g} m", ha="center")


def _write(axes: "Axes", x: float, y: float, text: str, **how: Any) -> Any:
    return axes.text(x, y, text, va="center", **{"fontsize": TEXT_PT, "color": _hex(INK), **how})


def _hex(color: int) -> str:
    return f"#{color:06X}"


def _rgb(color: int) -> tuple[int, int, int]:
    return color >> 16, color >> 8 & 255, color & 255
