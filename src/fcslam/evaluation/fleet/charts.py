"""What a fleet's run looks like from above: every robot's own map, the fused one, the building, and matched places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import binary_opening

from fcslam.errors import EvaluationError
from fcslam.evaluation.fleet.ground_truth import TRUE_MAP, KnownPoses, known_poses, read_grid, truth_folder
from fcslam.geometry import se2
from fcslam.metrics.grid import LabelledGrid
from fcslam.metrics.trajectory import align
from fcslam.records import Channel, ClosureStatus, FloatArray
from fcslam.runs import LOCAL, ClosureRow, LocalMap, Run, open_run

RAY_M: Final = 0.5
"""Known area thinner than this (single beams through doors) does not widen a chart, which has so wide a margin."""
AS_IT_IS: Final = (0.0, 0.0, 0.0)


class Match(NamedTuple):
    """An accepted closure between two robots: where each was, in its own map, when it saw the place."""

    robot_i: str
    xy_i: FloatArray
    robot_j: str
    xy_j: FloatArray
    channel: Channel


class Outline(NamedTuple):
    """Something that stands in the building."""

    corners: FloatArray
    """Shape (K, 2)."""
    furniture: bool


@dataclass(frozen=True, slots=True)
class Chart:
    """A map, and who drove where in it."""

    grid: LabelledGrid
    ways: Mapping[str, FloatArray]
    """Each robot's poses or points in the map's coordinate frame, shape (N, 2+)."""
    T_chart_map: tuple[float, float, float] = AS_IT_IS
    """How the map is laid on the chart."""
    outlines: Sequence[Outline] = ()

    def place(self, points: FloatArray) -> FloatArray:
        """Points (N, 2+) of the map on the chart, in metres, shape (N, 2)."""
        return np.asarray(se2.transform(self.T_chart_map, np.asarray(points, dtype=np.float64)[:, :2]))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest (x, y) on the chart of known area, ways and outlines."""
        side = max(1, round(RAY_M / self.grid.resolution_m))
        known = binary_opening(self.grid.free | self.grid.occupied, np.ones((side, side), np.bool_))
        points = [self.grid.centres(known), *self.ways.values(), *(outline.corners for outline in self.outlines)]
        placed = np.concatenate([self.place(part) for part in points])
        if not len(placed):
            return np.zeros(2), np.ones(2)
        return placed.min(axis=0) - RAY_M, placed.max(axis=0) + RAY_M


@dataclass(frozen=True, slots=True)
class FleetCharts:
    """Everything that the figure of a fleet shows."""

    local: Mapping[str, Chart]
    """Each robot's own map, as it is."""
    fused: Chart
    """The map of most robots, laid on the building."""
    building: Chart
    """The truth."""
    matches: Sequence[Match]


def fleet_charts(run: Path, truth: Path | None = None, outlines: Sequence[Outline] = ()) -> FleetCharts:
    """Charts of a run folder and its truth, which is looked for as ``evaluate_fleet`` does.

    ``outlines`` show what else stands in the building, in the truth's coordinate frame.

    Raises:
        EvaluationError: the run holds no robots' own maps, or the truth of a robot or the true map is not there.
    """
    opened, folder = open_run(run), truth_folder(run, truth)
    known = known_poses(opened, folder)
    if not opened.local_maps:
        raise EvaluationError(f"{run}: has no {LOCAL}/ with the robots' own maps; map the recordings again")
    return FleetCharts(
        local={
            robot: Chart(read_grid(run / LOCAL / f"{robot}.yaml"), {robot: local.T_local_base})
            for robot, local in opened.local_maps.items()
        },
        fused=_fused_chart(run, opened, known),
        building=Chart(
            read_grid(folder / TRUE_MAP),
            {robot: known.truth.T_map_base[known.truth.robots == k] for k, robot in enumerate(opened.local_maps)},
            outlines=outlines,
        ),
        matches=_matches(opened),
    )


def _fused_chart(run: Path, opened: Run, known: KnownPoses) -> Chart:
    members = known.estimate.maps == 0
    T_building_map = align(known.truth.T_map_base[members], known.estimate.T_map_base[members])
    x, y, theta = T_building_map if np.isfinite(T_building_map).all() else AS_IT_IS
    ways = {t.robot: t.T_map_base for t in opened.trajectories.values() if t.map_index == 0}
    return Chart(read_grid(run / "map.yaml"), ways, (float(x), float(y), float(theta)))


def _matches(run: Run) -> list[Match]:
    return [
        _match(closure, run.local_maps)
        for closure in run.closures
        if closure.status is ClosureStatus.ACCEPTED and closure.robot_i != closure.robot_j
    ]


def _match(closure: ClosureRow, local: Mapping[str, LocalMap]) -> Match:
    """The two ends in the order of the robots' names, whichever was there first."""
    ends = sorted([(closure.robot_i, closure.stamp_i), (closure.robot_j, closure.stamp_j)])
    (robot_i, xy_i), (robot_j, xy_j) = ((robot, _position(local[robot], stamp)) for robot, stamp in ends)
    return Match(robot_i, xy_i, robot_j, xy_j, closure.channel)


def _position(local: LocalMap, stamp: float) -> FloatArray:
    """Shape (2,), at the scan nearest to ``stamp``; stamps may step back."""
    return np.asarray(local.T_local_base[np.argmin(np.abs(local.stamps - stamp)), :2])


def spread(matches: Sequence[Match], most: int) -> list[Match]:
    """Up to ``most`` matches of each channel between each two robots, as far from one another as can be."""
    groups: dict[tuple[str, str, Channel], list[Match]] = {}
    for match in matches:
        groups.setdefault((match.robot_i, match.robot_j, match.channel), []).append(match)
    return [match for group in groups.values() for match in _farthest_first(group, most)]


def _farthest_first(matches: Sequence[Match], most: int) -> list[Match]:
    """The first, then always the one whose ends lie farthest from those of all that are chosen."""
    ends = np.array([(*match.xy_i, *match.xy_j) for match in matches])
    chosen = [0]
    gaps = np.linalg.norm(ends - ends[0], axis=1)
    while len(chosen) < min(most, len(matches)):
        chosen.append(int(np.argmax(gaps)))
        gaps = np.minimum(gaps, np.linalg.norm(ends - ends[chosen[-1]], axis=1))
    return [matches[k] for k in chosen]
