"""Where a map lies on the earth, by the fixes of its robots' satellite receivers.

The fixes of one map vote for its pose; those that contradict the others, as by reflections indoors, do not count. The
others are weak factors of the pose graph. Coordinates are metres east and north of a point whose latitude and longitude
are known, on the plane that touches the ellipsoid there (azimuthal equidistant projection of PROJ).
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.anchoring.part import LEAST_SIGMA_M, ROUNDS, MapPart, Positions
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray

OUTLIER: Final = 3.0
"""A fix that is farther off than this many standard deviations does not count."""
CORRELATED_S: Final = 10.0
"""Fixes in this time have the errors of one: those of satellites, air and reflections change slowly."""
LEAST_FIXES, LEAST_SHARE = 10, 0.3
"""Least number of fixes that agree, and least share of them."""
LEAST_INDEPENDENT: Final = 5.0
"""Fixes with errors of their own that show their errors."""
MISSTATED: Final = 1.5
"""Ratio of the errors of the fixes to the stated ones from which the stated ones are wrong."""
MOST_SPREAD: Final = 0.1
"""Largest ratio of errors that nobody stated to the extent of the map: beyond, the fixes are not of its path."""
CLEARLY_MORE: Final = 1.5
"""Ratio of the fixes that agree with changed coordinates to those that agree as they are, if these are wrong."""
MOST_TURN_RAD: Final = float(np.radians(3.0))
"""Largest standard deviation of the map's heading by the fixes that agree."""
HYPOTHESES: Final = 400
"""Pairs of fixes from which the pose of the map is guessed."""
_MEDIAN_OFF: Final = 1.1774
"""Half of all points of a plane with a standard deviation of 1 along both axes are nearer to their mean."""


@dataclass(frozen=True, slots=True, eq=False)
class _Measured(Positions):
    """Positions of antennas, metres east and north."""

    spread: float
    """Factor by which correlation in time enlarges the standard deviations."""
    factor: float = 1.0
    """Factor by which the standard deviations are larger than stated."""

    def off(self, antennas: FloatArray) -> FloatArray:
        """How far positions of the antenna (N, 2) are from the fixes, in their standard deviations; shape (N,)."""
        off: FloatArray = np.hypot(*(antennas - self.xy).T) / self.sigma_m
        return off


def georeferenced(part: MapPart, is_fixed: bool) -> tuple[MapPart, dict[str, Any]] | None:
    """Place a map on the earth, conclusively or not at all; None if it has no fix.

    A map that ``is_fixed`` keeps its frame and its poses; another one is turned so that x is east and y is north.

    Returns:
        The map, and what its file says: where it lies or why it is not placed, the fixes and those that contradict the
        others, and the standard deviation of the fixes by their distances from the path and as the receiver states it.
    """
    robots = part.robots
    kept = [fix for robot in robots for fix in robot.fixes]
    if not kept:
        return None
    report: dict[str, Any] = {"fixes": len(kept), "ignored": 0, "sigma_m": 0.0, "stated_sigma_m": 0.0}
    at = [np.array([fix.id.number for fix in robot.fixes], np.int64) for robot in robots]
    stated_m = np.array([fix.sigma_m for fix in kept])
    positions = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in kept])
    try:
        projection, east_north = _projected(positions)
    except ImportError:
        return part, _refused("fixes need pyproj; install it: pip install 'fcslam[gnss]'", report)
    gaps_s = np.concatenate([np.diff(np.sort(robot.stamps[rows])) for robot, rows in zip(robots, at, strict=True)])
    interval_s = float(np.median(gaps_s)) if len(gaps_s) else CORRELATED_S
    measured = _Measured(
        np.concatenate([robot.variables[rows] for robot, rows in zip(robots, at, strict=True)]),
        np.array([fix.antenna_xy for fix in kept]),
        east_north,
        np.maximum(LEAST_SIGMA_M, stated_m),
        max(1.0, CORRELATED_S / max(interval_s, 1e-3)) ** 0.5,
    )
    poses = part.graph.poses()
    antennas = measured.points(poses)
    measured, T, agreeing = _vote(measured, antennas)
    refusal = _refusal(measured, T, antennas, agreeing)
    if refusal or agreeing.mean() < 1.0 / CLEARLY_MORE:
        count = int(agreeing.sum())
        if explanation := _explanation(measured, antennas, positions, 0 if refusal else count):
            refusal = f"{refusal or f'{count} of {len(agreeing)} fixes agree'}; {explanation}"
    sigma_m = float(np.median(measured.sigma_m))
    stated_sigma_m = float(np.median(stated_m)) if measured.factor > 1.0 else sigma_m
    report |= {"ignored": int((~agreeing).sum()), "sigma_m": round(sigma_m, 4)}
    report["stated_sigma_m"] = round(stated_sigma_m, 4)
    if refusal:
        return part, _refused(refusal, report)
    if not is_fixed:
        poses, agreeing = _solve(part.graph, se2.compose(T, poses), measured, agreeing)
        part, T = part.at(poses), np.zeros(3)
    longitude, latitude = projection(*T[:2].tolist(), inverse=True)
    return part, {
        "georeferenced": True,
        "latitude_deg": round(latitude, 9),
        "longitude_deg": round(longitude, 9),
        "altitude_m": round(float(np.median([fix.altitude_m for fix in kept])), 3),
        "x_axis_from_east_deg": round(float(np.degrees(T[2])), 6),
        **report,
        "ignored": int((~agreeing).sum()),
    }


def _refused(reason: str, report: dict[str, Any]) -> dict[str, Any]:
    return {"georeferenced": False, "reason": reason, **report}


def _projected(positions: FloatArray) -> tuple[Any, FloatArray]:
    """The projection around latitudes and longitudes, shape (N, 2), and their metres east and north."""
    from pyproj import Proj

    latitude, longitude = np.median(positions, axis=0)
    projection = Proj(proj="aeqd", lat_0=latitude, lon_0=longitude, ellps="WGS84")
    return projection, np.column_stack(projection(positions[:, 1], positions[:, 0]))


def _vote(measured: _Measured, antennas: FloatArray) -> tuple[_Measured, FloatArray, NDArray[np.bool_]]:
    """The motion of the map to which most fixes are near, by pairs of fixes that lie apart; then by all that agree.

    Distances from the map that are larger than stated show how large the errors are.
    """
    rng = np.random.default_rng(0)
    needed = min(len(antennas), _needed(len(antennas))) - 1
    apart_m = np.hypot(*antennas.std(axis=0))
    best, off, nearest = np.zeros(3), np.full(len(antennas), np.inf), np.inf
    for _ in range(HYPOTHESES):
        i, j = rng.integers(len(antennas), size=2)
        if not np.hypot(*(antennas[i] - antennas[j])) > apart_m:
            continue
        T = n_point_alignment(measured.xy[[i, j]], antennas[[i, j]])
        distances = measured.off(se2.transform(T, antennas))
        if (reach := np.partition(distances, needed)[needed]) < nearest:
            best, off, nearest = T, distances, reach
    agreeing, factor = off <= nearest, 1.0
    for _ in range(2 * ROUNDS):
        if agreeing.sum() < 2:
            break
        weights = measured.sigma_m[agreeing] ** -2.0
        T = n_point_alignment(measured.xy[agreeing], antennas[agreeing], weights)
        if not np.isfinite(T).all():
            break
        best, off = T, measured.off(se2.transform(T, antennas))
        factor = float(np.median(off[agreeing])) / _MEDIAN_OFF
        factor = factor if factor > MISSTATED else 1.0
        agreeing = off < OUTLIER * factor
    return replace(measured, sigma_m=factor * measured.sigma_m, factor=factor), best, agreeing


def _needed(count: int) -> int:
    return max(LEAST_FIXES, round(LEAST_SHARE * count))


def _refusal(measured: _Measured, T: FloatArray, antennas: FloatArray, agreeing: NDArray[np.bool_]) -> str:
    count, sigmas_m = int(agreeing.sum()), measured.sigma_m
    if count < (needed := _needed(len(agreeing))):
        return f"{count} of {len(agreeing)} fixes agree, {needed} needed: fewer do not show which are wrong"
    if measured.factor > 1.0 and np.median(sigmas_m) > MOST_SPREAD * np.hypot(*antennas.std(axis=0)):
        return f"the fixes differ by {np.median(sigmas_m):.1f} m from the path of the robots"
    at = measured.xy[agreeing] - measured.xy[agreeing].mean(axis=0)
    sigma_m = float(np.sqrt(np.mean(sigmas_m[agreeing] ** 2)))
    if len(agreeing) >= LEAST_INDEPENDENT * measured.spread**2:  # they may be better than they state, too
        off_m = (measured.off(se2.transform(T, antennas)) * sigmas_m)[agreeing]
        sigma_m = min(sigma_m, float(np.sqrt(0.5 * np.mean(off_m**2))))
    turn_rad = measured.spread * sigma_m / max(1e-9, float(np.sqrt((at**2).sum())))
    if turn_rad > MOST_TURN_RAD:
        return (
            f"the fixes fix the map's heading to {np.degrees(turn_rad):.1f} deg only, "
            f"{np.degrees(MOST_TURN_RAD):.0f} deg needed; drive farther outdoors"
        )
    return ""


def _explanation(measured: _Measured, antennas: FloatArray, positions: FloatArray, count: int) -> str:
    """With which change of the coordinates clearly more than ``count`` fixes agree; empty if with none."""
    stated = replace(measured, sigma_m=measured.sigma_m / measured.factor, factor=1.0)
    size = np.hypot(*measured.xy.std(axis=0)) / np.hypot(*antennas.std(axis=0))
    changed = {
        "east and north exchanged, or a sign lost": measured.xy[:, ::-1],
        f"a scale of {size:.3g}": measured.xy / size,
    }
    exchanged, degrees = positions[:, ::-1], np.degrees(positions)
    for name, each in (("latitude and longitude exchanged", exchanged), ("radians for degrees", degrees)):
        if np.abs(each).max() <= 90.0:
            changed[name] = _projected(each)[1]
    for name, east_north in reversed(changed.items()):
        its, T, agreeing = _vote(replace(stated, xy=east_north), antennas)
        if agreeing.sum() > CLEARLY_MORE * count and not _refusal(its, T, antennas, agreeing):
            return f"with {name}, {agreeing.sum()} of {len(agreeing)} agree: correct the driver of the receiver"
    return ""


def _solve(
    graph: PoseGraph, poses: FloatArray, measured: _Measured, agreeing: NDArray[np.bool_]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    spreading = replace(measured, sigma_m=measured.spread * measured.sigma_m)
    for _ in range(ROUNDS):
        poses = spreading.solved(graph, poses, agreeing)
        before, agreeing = agreeing, measured.off(measured.points(poses)) < OUTLIER
        if np.array_equal(before, agreeing):
            break
    return poses, agreeing
