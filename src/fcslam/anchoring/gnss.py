"""Where a map lies on the earth, by the fixes of its robots' satellite receivers.

The fixes of one map vote for its pose; those that contradict the others, as by reflections indoors, do not count. The
others are weak factors of the pose graph. Coordinates are metres east and north of a point whose latitude and longitude
are known, on the plane that touches the ellipsoid there (azimuthal equidistant projection of PROJ).
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.anchoring.part import LEAST_SIGMA_M, ROUNDS, MapPart, position_prior
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.graph.optimizer import optimize_anchored
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray

OUTLIER: Final = 3.0
"""A fix that is farther off than this many standard deviations does not count."""
CORRELATED_S: Final = 10.0
"""Fixes in this time have the errors of one: those of satellites, air and reflections change slowly."""
LEAST_FIXES, LEAST_SHARE = 10, 0.3
"""Least number of fixes that agree, and least share of them."""
MOST_TURN_RAD: Final = float(np.radians(3.0))
"""Largest standard deviation of the map's heading by the fixes that agree."""
HYPOTHESES: Final = 400
"""Pairs of fixes from which the pose of the map is guessed."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """Where one map lies on the earth."""

    part: MapPart
    fixes: int
    """Fixes at a scan of the map."""
    ignored: int
    """Fixes that contradict the others."""
    refusal: str = ""
    """Why the map is not placed; empty if it is."""
    latitude_deg: float = 0.0
    """Latitude of the map's origin; the longitude and altitude are also those of the origin."""
    longitude_deg: float = 0.0
    altitude_m: float = 0.0
    heading_rad: float = 0.0
    """Direction of the map's x axis, counter-clockwise from east."""


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    variables: NDArray[np.int64]
    arms: FloatArray
    """The antenna in the base of the keyscan, shape (N, 2)."""
    east_north: FloatArray
    """Shape (N, 2), metres."""
    sigma_m: FloatArray
    """Shape (N,)."""
    spread: float
    """Factor by which correlation in time enlarges the standard deviations."""

    def antennas(self, poses: FloatArray) -> FloatArray:
        """Positions of the antenna, shape (N, 2), by poses of the variables."""
        at = poses[self.variables]
        cos, sin = np.cos(at[:, 2]), np.sin(at[:, 2])
        x, y = self.arms.T
        antennas: FloatArray = at[:, :2] + np.column_stack((cos * x - sin * y, sin * x + cos * y))
        return antennas

    def agrees(self, antennas: FloatArray) -> NDArray[np.bool_]:
        """Which fixes agree with positions of the antenna (N, 2), shape (N,)."""
        off: NDArray[np.bool_] = np.hypot(*(antennas - self.east_north).T) < OUTLIER * self.sigma_m
        return off


def georeferenced(part: MapPart, is_fixed: bool) -> Georeference | None:
    """Place a map on the earth, conclusively or not at all; None if it has no fix.

    A map that ``is_fixed`` keeps its frame and its poses; another one is turned so that x is east and y is north.
    """
    robots = part.robots
    kept = [fix for robot in robots for fix in robot.fixes]
    if not kept:
        return None
    at = [np.array([fix.id.number for fix in robot.fixes], np.int64) for robot in robots]
    try:
        from pyproj import Proj
    except ImportError:
        return Georeference(part, len(kept), 0, "fixes need pyproj; install it: pip install 'fcslam[gnss]'")
    middle = np.median([(fix.latitude_deg, fix.longitude_deg, fix.altitude_m) for fix in kept], axis=0)
    projection: Any = Proj(proj="aeqd", lat_0=middle[0], lon_0=middle[1], ellps="WGS84")
    east, north = projection([fix.longitude_deg for fix in kept], [fix.latitude_deg for fix in kept])
    gaps_s = np.concatenate([np.diff(np.sort(robot.stamps[rows])) for robot, rows in zip(robots, at, strict=True)])
    interval_s = float(np.median(gaps_s)) if len(gaps_s) else CORRELATED_S
    measured = _Measured(
        np.concatenate([robot.variables[rows] for robot, rows in zip(robots, at, strict=True)]),
        np.array([fix.antenna_xy for fix in kept]),
        np.column_stack((east, north)),
        np.maximum(LEAST_SIGMA_M, [fix.sigma_m for fix in kept]),
        max(1.0, CORRELATED_S / max(interval_s, 1e-3)) ** 0.5,
    )
    poses = part.graph.poses()
    T, agreeing = _vote(measured, measured.antennas(poses))
    refusal = _refusal(measured, agreeing)
    if refusal:
        return Georeference(part, len(kept), int((~agreeing).sum()), refusal)
    if not is_fixed:
        poses, agreeing = _solve(part.graph, se2.compose(T, poses), measured, agreeing)
        part, T = part.at(poses), np.zeros(3)
    longitude, latitude = projection(*T[:2].tolist(), inverse=True)
    ignored = int((~agreeing).sum())
    return Georeference(part, len(kept), ignored, "", latitude, longitude, float(middle[2]), float(T[2]))


def _vote(measured: _Measured, antennas: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """The motion of the map with which most fixes agree, by pairs of fixes that lie apart; then by all that agree."""
    rng = np.random.default_rng(0)
    best, agreeing = np.zeros(3), np.zeros(len(antennas), bool)
    for _ in range(HYPOTHESES):
        i, j = rng.integers(len(antennas), size=2)
        if np.hypot(*(antennas[i] - antennas[j])) < OUTLIER * max(measured.sigma_m[i], measured.sigma_m[j]):
            continue
        T = n_point_alignment(measured.east_north[[i, j]], antennas[[i, j]])
        votes = measured.agrees(se2.transform(T, antennas))
        if votes.sum() > agreeing.sum():
            best, agreeing = T, votes
    for _ in range(ROUNDS):
        if agreeing.sum() < 2:
            break
        weights = measured.sigma_m[agreeing] ** -2.0
        T = n_point_alignment(measured.east_north[agreeing], antennas[agreeing], weights)
        if not np.isfinite(T).all():
            break
        best, agreeing = T, measured.agrees(se2.transform(T, antennas))
    return best, agreeing


def _refusal(measured: _Measured, agreeing: NDArray[np.bool_]) -> str:
    count = int(agreeing.sum())
    if count < max(LEAST_FIXES, LEAST_SHARE * len(agreeing)):
        return f"{count} of {len(agreeing)} fixes agree, {max(LEAST_FIXES, LEAST_SHARE * len(agreeing)):.0f} needed"
    at = measured.east_north[agreeing] - measured.east_north[agreeing].mean(axis=0)
    sigma_m = float(np.sqrt(np.mean(measured.sigma_m[agreeing] ** 2))) * measured.spread
    turn_rad = sigma_m / max(1e-9, float(np.sqrt((at**2).sum())))
    if turn_rad > MOST_TURN_RAD:
        return (
            f"the fixes fix the map's heading to {np.degrees(turn_rad):.1f} deg only, "
            f"{np.degrees(MOST_TURN_RAD):.0f} deg needed; drive farther outdoors"
        )
    return ""


def _solve(
    graph: PoseGraph, poses: FloatArray, measured: _Measured, agreeing: NDArray[np.bool_]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    for _ in range(ROUNDS):
        arms = measured.antennas(poses) - poses[measured.variables, :2]
        priors = [
            position_prior(
                variable,
                measured.east_north[row] - arms[row],
                poses[variable, 2],
                (measured.spread * measured.sigma_m[row]) ** -2.0,
            )
            for row, variable in enumerate(measured.variables.tolist())
            if agreeing[row]
        ]
        poses = optimize_anchored(graph, poses, priors)
        before, agreeing = agreeing, measured.agrees(measured.antennas(poses))
        if np.array_equal(before, agreeing):
            break
    return poses, agreeing
