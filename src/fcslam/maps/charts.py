"""Charts of a fleet: maps with trajectories and matched places in metres, which ``fleet_figure`` draws."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import binary_opening

from fcslam.geometry import se2
from fcslam.metrics.grid import LabelledGrid
from fcslam.records import Channel, FloatArray

RAY_M: Final = 0.5
"""Known area thinner than this, such as single beams through doors, does not extend a chart. Also its margin."""
IDENTITY: Final = (0.0, 0.0, 0.0)


class MatchedPlaces(NamedTuple):
    """A verified closure between two robots: the position of each in its own map, shape (2,), metres."""

    robot_i: str
    xy_i: FloatArray
    robot_j: str
    xy_j: FloatArray
    channel: Channel
    accepted: bool
    """Whether the joint map uses it."""


class Outline(NamedTuple):
    """A wall or a piece of furniture."""

    corners: FloatArray
    """Shape (K, 2), metres in the chart's map."""
    furniture: bool


@dataclass(frozen=True, slots=True)
class Chart:
    """A map and the trajectories of robots in it."""

    grid: LabelledGrid
    trajectories: Mapping[str, FloatArray]
    """Each robot's poses or points in the map's coordinate frame, shape (N, 2+)."""
    T_chart_map: tuple[float, float, float] = IDENTITY
    """Pose of the map on the chart: x, y in metres, theta in radians."""
    outlines: Sequence[Outline] = ()

    def place(self, points: FloatArray) -> FloatArray:
        """Transform points (N, 2+) of the map to the chart, metres, shape (N, 2)."""
        return np.asarray(se2.transform(self.T_chart_map, np.asarray(points, dtype=np.float64)[:, :2]))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower left and upper right corner (2,), metres on the chart, of known area, trajectories and outlines."""
        side = max(1, round(RAY_M / self.grid.resolution_m))
        known = binary_opening(self.grid.free | self.grid.occupied, np.ones((side, side), np.bool_))
        points = [
            self.grid.centres(known),
            *self.trajectories.values(),
            *(outline.corners for outline in self.outlines),
        ]
        placed = np.concatenate([self.place(part) for part in points])
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
