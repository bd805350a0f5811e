"""Whether two local maps show the same place: how far their walls lie apart, and which walls contradict.

Places that look alike differ in detail. At the right transform, the walls of two maps lie on each other as well as the
walls of two halves of one robot's own scans. At a wrong one, they lie some centimetres off, and some stand in the free
space of the other map.

Walls are compared in stretches of ``STRETCH_M``, whose offset ``o`` from the wall of the other map is a mean over their
points. With the noise ``s`` of such an offset in the maps themselves, its log-likelihood ratio is

    log p(o | same) - log p(o | other)
    p(o | same)  = (1 - u) N(o; 0, s^2 + SAME_M^2)  + u U,  u = MOVED
    p(o | other) = (1 - v) N(o; 0, s^2 + OTHER_M^2) + v U,  v = UNLIKE

where ``U`` is uniform over the reach of a comparison. A stretch in free space has the ratio of the shares of such
stretches in maps of the same place and of another. The halves of a robot's scans are those before and after the middle
of its path there, so that the noise includes the drift in between.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.lidar.field import EMPTY, label_at
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import FREE_CELL_M, SPACING_M, VIOLATION_M, Submap, build_with_halves, seen_through
from fcslam.records import FloatArray

STRETCH_M: Final = 5.0 * SPACING_M
"""Length of a stretch of wall: one independent measurement."""
FEWEST_POINTS: Final = 0.5 * STRETCH_M / SPACING_M
"""Least points of a stretch: half of it is known."""
SAME_M, OTHER_M = 0.004, 0.03
"""Standard deviations of an offset, beyond the noise, in the same place and in another that looks alike, by comparisons
of recorded logs and of drives in published floors."""
MOVED, UNLIKE = 0.1, 0.4
MOST_MOVED: Final = 3.0 * MOVED
"""Shares of stretches with an arbitrary offset: moved furniture, at least and at most, and walls of another place."""
IN_FREE, IN_FREE_ELSEWHERE = 0.02, 0.11
"""Shares of stretches in free space, in the same place and in another, for maps that do not contradict themselves."""
MOST_SELF_IN_FREE: Final = 0.15
"""The share by which a map contradicts itself raises both by no more than this."""
WALL_M: Final = 0.8
"""Walls of at least this length contradict; shorter things are people, furniture and doors."""
FEWEST_STRETCHES: Final = 20
"""With fewer stretches, the noise is assumed to be ``NOISE_M``, that of a common laser."""
NOISE_M: Final = 0.01
WIDEST_NOISE_M: Final = 10.0 * NOISE_M
THROUGH_M: Final = 0.5 * STRETCH_M
"""A wall contradicts where the other map is free at this distance on both of its sides: beams passed through it. At the
edge of what a robot saw, its free space touches walls that it did not see."""
PARALLEL: Final = 0.7
"""Least product of the normals of two points on one wall."""

_UNKNOWN, _ON_WALL, _IN_FREE, _DEEP_IN_FREE = range(4)


class PlaceAgreement(NamedTuple):
    """How well two local maps agree at a transform; the sums over several places add up (``total``)."""

    support: float = 0.0
    """Log-likelihood ratio of the same place to another, nats."""
    expected: float = 0.0
    """Its expectation if the maps show the same place."""
    compared_m: float = 0.0
    """Walls of each map in known area of the other, metres, summed over both maps."""
    contradicting_m: float = 0.0
    """Those of ``WALL_M`` or more in the other's free space, farther than the reach of its walls."""


def total(agreements: Sequence[PlaceAgreement]) -> PlaceAgreement:
    """The agreement over all places; zero without any."""
    return PlaceAgreement(*(float(sum(values)) for values in zip(PlaceAgreement(), *agreements, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class LocalSubmap:
    """A submap, and how its two halves agree."""

    submap: Submap
    offsets_m: FloatArray
    """Offsets of stretches between two halves of its scans, shape (K,)."""
    is_solid: NDArray[np.bool_]
    """Points of the surface that few beams passed, shape (N,): things that the robot saw through contradict nothing."""
    in_free: float
    """Share of the stretches of one half in the free space of the other."""
    contradicting_m: float
    """Walls of one half in the free space of the other, as ``PlaceAgreement.contradicting_m``."""


class Noise(NamedTuple):
    """How well the local maps of one robot agree with themselves."""

    offset_m: float = NOISE_M
    """Standard deviation of an offset."""
    moved: float = MOVED
    """Share of stretches whose offset is arbitrary."""
    contradiction: float = 0.0
    """Share of walls that contradict."""


def local_map(scans: Sequence[tuple[PointScan, FloatArray]], radius_m: float) -> LocalSubmap:
    """The map of at least two scans, as for ``build_submap``."""
    middle = len(scans) // 2
    whole, first, second = build_with_halves(scans, radius_m)
    compared = [_stretches(first, second, np.zeros(3)), _stretches(second, first, np.zeros(3))]
    offsets_m: FloatArray = np.concatenate([offsets_m for offsets_m, _, _ in compared])
    in_free = max(count / max(1, count + len(offsets_m)) for offsets_m, count, _ in compared)
    halves = ((first, scans[:middle]), (second, scans[middle:]))
    contradicting_m = sum(
        _length_m(half.surface.points[deep & ~seen_through(half, part)])
        for (_, _, deep), (half, part) in zip(compared, halves, strict=True)
        if deep.any()
    )
    return LocalSubmap(whole, offsets_m, ~seen_through(whole, scans), in_free, contradicting_m)


def noise_of(maps: Iterable[LocalSubmap]) -> Noise:
    """The noise of one robot, from all of its local maps together."""
    known = list(maps)
    offsets_m = np.abs(np.concatenate([np.empty(0), *(each.offsets_m for each in known)]))
    if len(offsets_m) < FEWEST_STRETCHES:
        return Noise()
    offset_m = min(WIDEST_NOISE_M, float(np.quantile(offsets_m, 0.68)))
    moved = min(MOST_MOVED, max(MOVED, float(np.mean(offsets_m > 3.0 * offset_m))))
    contradicting_m = sum(each.contradicting_m for each in known)
    return Noise(offset_m, moved, contradicting_m / (contradicting_m + STRETCH_M * len(offsets_m)))


def compare(a: LocalSubmap, b: LocalSubmap, T_a_b: FloatArray, noise: Noise) -> PlaceAgreement:
    """Compare two local maps at a transform (3,), each map's walls with the other map.

    ``noise`` is that of the noisier robot; the share by which it contradicts itself is not counted.
    """
    in_free = IN_FREE + min(MOST_SELF_IN_FREE, max(a.in_free, b.in_free))
    in_free_elsewhere = in_free + IN_FREE_ELSEWHERE - IN_FREE
    on_wall = np.log((1.0 - in_free) / (1.0 - in_free_elsewhere))
    inside = np.log(in_free / in_free_elsewhere)
    mean = (1.0 - in_free) * (_expected_ratio(noise) + on_wall) + in_free * inside
    found = []
    for query, target, T in ((b, a, T_a_b), (a, b, se2.inverse(T_a_b))):
        offsets_m, free, deep = _stretches(query.submap, target.submap, T)
        count = len(offsets_m) + free
        ratios = _log_ratio(offsets_m, noise) + on_wall
        support = float(ratios.sum() + free * inside)
        against_m = _length_m(query.submap.surface.points[deep & query.is_solid])
        excess_m = against_m - noise.contradiction * STRETCH_M * count
        found.append(PlaceAgreement(support, count * mean, STRETCH_M * count, excess_m))
    return total(found)


def _log_ratio(offsets_m: FloatArray, noise: Noise) -> FloatArray:
    same = _density(offsets_m, np.hypot(noise.offset_m, SAME_M), noise.moved)
    return np.asarray(np.log(same / _density(offsets_m, np.hypot(noise.offset_m, OTHER_M), UNLIKE)))


def _density(offsets_m: FloatArray, sigma_m: float, uniform: float) -> FloatArray:
    normal = np.exp(-0.5 * (offsets_m / sigma_m) ** 2) / (np.sqrt(2.0 * np.pi) * sigma_m)
    return np.asarray((1.0 - uniform) * normal + uniform / (2.0 * VIOLATION_M))


def _expected_ratio(noise: Noise) -> float:
    offsets_m = np.linspace(-VIOLATION_M, VIOLATION_M, 601)
    weights = _density(offsets_m, float(np.hypot(noise.offset_m, SAME_M)), noise.moved)
    return float((weights * _log_ratio(offsets_m, noise)).sum() / weights.sum())


def _stretches(query: Submap, target: Submap, T_target_query: FloatArray) -> tuple[FloatArray, int, NDArray[np.bool_]]:
    """Offsets of the stretches on a wall, along its normal, shape (K,), and how many stretches lie in free space.

    And which points of the map are in free space, farther than the reach of the other's walls, shape (N,).
    """
    points, normals = query.surface.points, query.surface.normals
    offsets_m, states = _offsets(points, normals, T_target_query, target.field.arrays, target.free, target.free_corner)
    known = states != _UNKNOWN
    if not known.any():
        return np.empty(0), 0, known
    cells = np.floor(points[known] / STRETCH_M).astype(np.int64)
    facing = np.round(np.arctan2(normals[known, 1], normals[known, 0]) / (0.5 * np.pi)).astype(np.int64) % 4
    _, number = np.unique(np.column_stack((cells, facing)), axis=0, return_inverse=True)
    number = number.ravel()
    on_wall = states[known] == _ON_WALL
    walls, counts = (np.bincount(number, weights=each) for each in (on_wall, np.ones(len(number))))
    sums_m = np.bincount(number, weights=np.where(on_wall, offsets_m[known], 0.0))
    is_wall, is_free = walls >= FEWEST_POINTS, (counts >= FEWEST_POINTS) & (2.0 * walls < counts)
    in_free = int(np.count_nonzero(is_free & ~is_wall))
    return sums_m[is_wall] / walls[is_wall], in_free, states == _DEEP_IN_FREE


def _length_m(points: FloatArray) -> float:
    """Length of the walls of at least ``WALL_M`` among points ``SPACING_M`` apart, shape (N, 2)."""
    from scipy.ndimage import binary_dilation, label  # most robots are alone, and SciPy takes long to load

    if not len(points):
        return 0.0
    cells = np.floor((points - points.min(axis=0)) / SPACING_M).astype(np.int64)
    image = np.zeros(cells.max(axis=0) + 1, bool)
    image[tuple(cells.T)] = True
    around = np.ones((3, 3), np.bool_)
    wall = label(binary_dilation(image, around), around)[0][tuple(cells.T)]  # points with a gap of a cell are connected
    walls = (points[wall == number] for number in np.unique(wall))
    return SPACING_M * sum(len(each) for each in walls if np.hypot(*np.ptp(each, axis=0)) >= WALL_M)


@njit
def _offsets(points, normals, T, field, free, free_corner):  # type: ignore[no-untyped-def]
    cos, sin = np.cos(T[2]), np.sin(T[2])
    offsets, states = np.zeros(len(points)), np.zeros(len(points), np.int8)
    for i in range(len(points)):
        x = T[0] + cos * points[i, 0] - sin * points[i, 1]
        y = T[1] + sin * points[i, 0] + cos * points[i, 1]
        label, distance = label_at(x, y, field), 10.0
        mx = cos * normals[i, 0] - sin * normals[i, 1]
        my = sin * normals[i, 0] + cos * normals[i, 1]
        if label != EMPTY:
            s = field.surfels[label]
            dx, dy = x - s[0], y - s[1]
            distance = np.hypot(dx, dy)
            if distance < VIOLATION_M and s[2] * mx + s[3] * my > PARALLEL:
                offsets[i] = dx * s[2] + dy * s[3]
                states[i] = _ON_WALL
                continue
        if distance > VIOLATION_M and _is_free(x, y, free, free_corner):
            if label != EMPTY:
                states[i] = _IN_FREE
            elif _is_free(x - THROUGH_M * mx, y - THROUGH_M * my, free, free_corner) and _is_free(
                x + THROUGH_M * mx, y + THROUGH_M * my, free, free_corner
            ):
                states[i] = _DEEP_IN_FREE
    return offsets, states


@njit
def _is_free(x, y, free, corner):  # type: ignore[no-untyped-def]
    column, row = int(np.floor((x - corner[0]) / FREE_CELL_M)), int(np.floor((y - corner[1]) / FREE_CELL_M))
    return 0 <= column < free.shape[1] and 0 <= row < free.shape[0] and free[row, column]
