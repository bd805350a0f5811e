"""Whether two maps fit each other in one way only: an exhaustive alignment, and the best one elsewhere.

A false closure is as certain of itself as a true one where a building repeats. The maps around it distinguish them. At
a false transform, the walls of one map stand in the free space of the other, or the same walls fit a second time, one
door farther. So this module aligns both maps at every heading and position, and compares the transform in question with
the best one elsewhere.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import distance_transform_edt

from fcslam.geometry import se2
from fcslam.lidar.matching import match_scan
from fcslam.lidar.submap import FREE_CELL_M, SPACING_M, Submap, agreement
from fcslam.records import FloatArray

Spectrum = NDArray[np.complex64]

CELL_M = 0.25
"""Side of a cell of the exhaustive search."""
WELL_INSIDE_M = 0.5
"""A point in free space farther than this from any surface contradicts it, in the exhaustive search."""
VIOLATION_WEIGHT = 2.0
"""Metres of explained surface that a metre of surface in free space cancels."""
ELSEWHERE_M, ELSEWHERE_RAD = 1.0, np.radians(15.0)
"""Transforms this far apart are two."""
PEAKS = 3
"""Best positions that are kept for each heading."""
REFINED = 12
"""Best distinct transforms that are refined and scored exactly."""
REFINEMENT_SCALE_M = 0.4
_ALIGNED_POINTS = 800
"""Points of a map that are aligned, about."""


@dataclass(frozen=True, slots=True)
class MapAlignment:
    """How well two maps fit at one transform."""

    T_a_b: FloatArray
    """Shape (3,), metres and radians."""
    explained_m: float
    """Distinct surface of one map that lies on surfaces of the other: of both maps, the one with less."""
    violating_m: float
    """Surface of one map in free space of the other: of both maps, the one with more."""
    violation: float
    """The same as a share of the surface in known area."""
    known_m: float
    """Surface of one map in known area of the other: of both maps, the one with less."""

    @property
    def score_m(self) -> float:
        """Metres of surface that speak for the transform, net of those that speak against it."""
        return self.explained_m - VIOLATION_WEIGHT * self.violating_m


def align_map(a: Submap, b: Submap, T_a_b: FloatArray) -> MapAlignment:
    """Refine a transform between two maps and score it.

    Args:
        a, b: maps, each in the coordinate frame of its anchor.
        T_a_b: initial guess, shape (3,), metres and radians.
    """
    step = max(1, len(b.surface) // _ALIGNED_POINTS)
    sample = b.surface.only(np.arange(0, len(b.surface), step))
    T_a_b = match_scan(sample, a.field, T_a_b, np.zeros((3, 3)), wide_scale_m=REFINEMENT_SCALE_M).T_field_base
    sides = agreement(b, a, T_a_b), agreement(a, b, se2.inverse(T_a_b))
    known = [side.overlap * len(surface) for side, surface in zip(sides, (b.surface, a.surface), strict=True)]
    violating = [side.violation * count for side, count in zip(sides, known, strict=True)]
    explained_m, violating_m = SPACING_M * min(side.count for side in sides), SPACING_M * max(violating)
    known_m = SPACING_M * min(known)
    return MapAlignment(T_a_b, explained_m, violating_m, max(side.violation for side in sides), known_m)


def best_elsewhere(a: Submap, b: Submap, T_a_b: FloatArray) -> MapAlignment | None:
    """The best alignment of two maps that is not ``T_a_b``, from all headings and all positions.

    Args:
        a, b: maps, each in the coordinate frame of its anchor.
        T_a_b: the transform in question, shape (3,), metres and radians.

    Returns:
        The alignment; None if a map is empty or no other transform puts a surface on a surface.
    """
    if not len(a.surface) or not len(b.surface):
        return None
    middle = b.surface.points.mean(axis=0, keepdims=True)
    refined = (align_map(a, b, pose) for pose in _distinct_peaks(a, b, middle, [T_a_b]))
    rivals = (rival for rival in refined if is_elsewhere(rival.T_a_b, T_a_b, middle))
    return max(rivals, key=lambda rival: rival.score_m, default=None)


def two_best(
    a: Submap, b: Submap, headings: FloatArray | None = None
) -> tuple[MapAlignment, MapAlignment | None] | None:
    """The best alignment of two maps from all headings and all positions, and the best one elsewhere, if any.

    Args:
        a, b: maps, each in the coordinate frame of its anchor.
        headings: headings of b in a, shape (H,), radians; None: all.

    Returns:
        The two alignments; None if a map is empty.
    """
    if not len(a.surface) or not len(b.surface):
        return None
    middle = b.surface.points.mean(axis=0, keepdims=True)
    refined = [align_map(a, b, pose) for pose in _distinct_peaks(a, b, middle, [], headings)]
    best = max(refined, key=lambda alignment: alignment.score_m)
    rivals = (rival for rival in refined if is_elsewhere(rival.T_a_b, best.T_a_b, middle))
    return best, max(rivals, key=lambda rival: rival.score_m, default=None)


def _distinct_peaks(
    a: Submap, b: Submap, middle: FloatArray, known: list[FloatArray], headings: FloatArray | None = None
) -> list[FloatArray]:
    """The best transforms of the exhaustive search that are elsewhere than each other and than the ``known`` ones."""
    distinct = list(known)
    for _, pose in sorted(_coarse_peaks(a, b, headings), key=lambda peak: -peak[0]):
        if all(is_elsewhere(pose, other, middle) for other in distinct):
            distinct.append(pose)
        if len(distinct) >= REFINED + len(known):
            break
    return distinct[len(known) :]


def is_elsewhere(one: FloatArray, other: FloatArray, middle: FloatArray) -> bool:
    """Whether two transforms T_a_b put the middle (1, 2) of b at two places, or turn b differently."""
    gap = se2.transform(one, middle) - se2.transform(other, middle)
    turn = abs(se2.wrap_angle(one[2] - other[2]))
    return bool(np.linalg.norm(gap) > ELSEWHERE_M or turn > ELSEWHERE_RAD)


@dataclass(frozen=True, slots=True)
class _Drawing:
    """A map as points around the middle of its surface, metres."""

    surface: FloatArray
    """Shape (N, 2)."""
    inside: FloatArray
    """Centres of the free cells well away from any surface, shape (M, 2)."""
    middle: FloatArray
    """Shape (2,), in the map's own coordinates."""
    reach_m: float
    """Distance of the farthest of these points."""


def _drawing(submap: Submap) -> _Drawing:
    free, points = submap.free, submap.surface.points
    surface = np.zeros_like(free.cells)
    column, row = np.floor((points - free.corner) / FREE_CELL_M).astype(np.int64).T
    surface[row, column] = True
    away = distance_transform_edt(~surface) * FREE_CELL_M > WELL_INSIDE_M
    rows, columns = np.nonzero(free.cells & away)
    middle = points.mean(axis=0)
    inside = (np.column_stack((columns, rows)) + 0.5) * FREE_CELL_M + free.corner - middle
    reach_m = float(np.hypot(*np.concatenate((points - middle, inside)).T).max())
    return _Drawing(points - middle, inside, middle, reach_m)


def _coarse_peaks(a: Submap, b: Submap, headings: FloatArray | None = None) -> Iterator[tuple[float, FloatArray]]:
    """Score and T_a_b of the best positions for every heading, by correlation of images."""
    one, other = _drawing(a), _drawing(b)
    cells = fft.next_fast_len(int(np.ceil(2.0 * (one.reach_m + other.reach_m) / CELL_M)) + 2, real=True)
    smear = _smear(cells)
    surface_a, worth_a = _spectra(one, 0.0, smear)
    for heading in _all_headings(other) if headings is None else headings:
        surface_b, worth_b = _spectra(other, heading, smear)
        scores = fft.irfft2(worth_a * np.conj(surface_b) + surface_a * np.conj(worth_b), (cells, cells))
        for _ in range(PEAKS):
            row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
            shift = np.array([column, row], dtype=np.float64)
            shift = CELL_M * np.where(shift > cells / 2, shift - cells, shift)
            T_middle = np.append(shift + one.middle, heading)
            yield float(scores[row, column]), se2.compose(T_middle, np.append(-other.middle, 0.0))
            near = np.arange(-4, 5)
            scores[np.ix_((row + near) % cells, (column + near) % cells)] = -np.inf


def _all_headings(drawing: _Drawing) -> FloatArray:
    lever_m = float(np.quantile(np.hypot(*drawing.surface.T), 0.9))
    count = max(36, int(np.ceil(2.0 * np.pi * lever_m / (1.5 * CELL_M))))
    return np.asarray(np.arange(count) * (2.0 * np.pi / count), np.float64)


def _smear(cells: int) -> NDArray[np.float32]:
    """Spectrum of a Gaussian that is 1 on a straight wall, shape (cells, cells // 2 + 1)."""
    y, x = np.meshgrid(fft.fftfreq(cells), fft.rfftfreq(cells), indexing="ij")
    spectrum: NDArray[np.float32] = np.exp(-2.0 * np.pi**2 * (x * x + y * y)).astype(np.float32)
    return spectrum * np.float32(np.sqrt(2.0 * np.pi))


def _spectra(drawing: _Drawing, heading: float, smear: NDArray[np.float32]) -> tuple[Spectrum, Spectrum]:
    """Spectra of a turned map: the cells with a surface, and the score of such a cell of another map in each cell.

    Single precision is enough for peaks that are refined later, and takes two thirds of the time.
    """
    cells = len(smear)
    turn = np.array([0.0, 0.0, heading])
    surface, inside = np.zeros((2, cells, cells), np.float32)
    row, column = _cells_of(se2.transform(turn, drawing.surface), cells)
    surface[row, column] = 1.0
    row, column = _cells_of(se2.transform(turn, drawing.inside), cells)
    inside[row, column] = VIOLATION_WEIGHT
    occupied = fft.rfft2(surface)
    return occupied, occupied * smear - fft.rfft2(inside)


def _cells_of(points: FloatArray, cells: int) -> NDArray[np.int64]:
    """Row and column of each point, shape (2, N); the origin is in the middle of the image."""
    at: NDArray[np.int64] = np.floor(points / CELL_M).astype(np.int64) + cells // 2
    return at[:, ::-1].T
