"""Whether two maps fit each other in one way only: an exhaustive alignment, and the best one elsewhere.

A false closure is as certain of itself as a true one where a building repeats. The maps around it distinguish them. At
a false transform, the walls of one map stand in the free space of the other, or the same walls fit a second time, one
door farther. So this module aligns both maps at every heading and position, and compares the transform in question with
the best one elsewhere.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import distance_transform_edt

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.graph.evidence import DISTINCT_M, DISTINCT_RAD
from fcslam.lidar.matching import match_scan
from fcslam.lidar.submap import FREE_CELL_M, SPACING_M, Submap, agreement
from fcslam.lidar.verification import ALIGNED_POINTS, ALIGNMENT_SCALE_M
from fcslam.records import FloatArray

Spectrum = NDArray[np.complex64]

CELL_M = 0.25
"""Side of a cell of the exhaustive search."""
WELL_INSIDE_M = 2.0 * CELL_M
"""A point in free space farther than this from any surface contradicts it, in the exhaustive search."""
VIOLATION_WEIGHT = 2.0
"""Metres of explained surface that a metre of surface in free space cancels."""
PEAKS = 3
"""Best positions that are kept for each heading."""
REFINED = 4 * PEAKS
"""Best distinct transforms that are refined and scored exactly."""
PARALLEL_SHARE = 0.5
"""Headings at which at least this share of the most walls are parallel are searched where two maps are alike."""
DIRECTION_DEG = 2.5
"""Standard deviation of the directions of parallel walls."""


@dataclass(frozen=True, slots=True)
class MapAlignment:
    """How well two maps fit at one transform."""

    T_a_b: FloatArray
    score_m: float
    """Metres of distinct surface that lie on surfaces of the other map, net of those in its free space."""
    violation: float
    """Share of the surface in known area that lies in free space of the other: of both maps, the one with more."""
    known_m: float
    """Surface of one map in known area of the other: of both maps, the one with less."""


def align_map(a: Submap, b: Submap, T_a_b: FloatArray) -> MapAlignment:
    """Refine a transform (3,) between two maps, each in the coordinate frame of its anchor, and score it."""
    step = max(1, len(b.surface) // (2 * ALIGNED_POINTS))
    sample = b.surface.only(np.arange(0, len(b.surface), step))
    T_a_b = match_scan(sample, a.field, T_a_b, np.zeros((3, 3)), wide_scale_m=ALIGNMENT_SCALE_M).T_field_base
    sides = agreement(b, a, T_a_b), agreement(a, b, se2.inverse(T_a_b))
    known = [side.overlap * len(surface) for side, surface in zip(sides, (b.surface, a.surface), strict=True)]
    violating = [side.violation * count for side, count in zip(sides, known, strict=True)]
    explained_m, violating_m = SPACING_M * min(side.count for side in sides), SPACING_M * max(violating)
    score_m = explained_m - VIOLATION_WEIGHT * violating_m
    return MapAlignment(T_a_b, score_m, max(side.violation for side in sides), SPACING_M * min(known))


def alignments(
    a: Submap, b: Submap, T_a_b: FloatArray | None = None, headings: FloatArray | None = None
) -> list[MapAlignment]:
    """The best alignments of two maps from all headings and positions, the best one first; none if a map is empty.

    Args:
        a, b: maps, each in the coordinate frame of its anchor.
        T_a_b: alignments elsewhere than this transform, shape (3,), are looked for; None: any.
        headings: headings of b in a, shape (H,), radians, each of which stands for half a turn farther, too; None: all.
    """
    if not len(a.surface) or not len(b.surface):
        return []
    if _lever_m(a) < _lever_m(b):  # a small map needs fewer headings, and smaller images
        back = None if T_a_b is None else se2.inverse(T_a_b)
        turned = alignments(b, a, back, None if headings is None else -headings)
        return [replace(each, T_a_b=se2.inverse(each.T_a_b)) for each in turned]
    middle = b.surface.points.mean(axis=0, keepdims=True)
    known = [] if T_a_b is None else [T_a_b]
    distinct = [*known]
    for pose in _coarse_peaks(a, b, headings):
        if all(is_elsewhere(pose, other, middle) for other in distinct):
            distinct.append(pose)
        if len(distinct) >= REFINED + len(known):
            break
    refined = (align_map(a, b, pose) for pose in distinct[len(known) :])
    found = [each for each in refined if all(is_elsewhere(each.T_a_b, other, middle) for other in known)]
    return sorted(found, key=lambda each: -each.score_m)


def best_alignment(
    a: Submap, b: Submap, least_rival_m: float, headings: FloatArray | None = None
) -> tuple[MapAlignment, float] | None:
    """The best of the ``alignments``, and the ratio of its score to that of the best one elsewhere.

    The one elsewhere counts as ``least_rival_m`` at least: a few walls are never unique. None if a map is empty.
    """
    found = alignments(a, b, headings=headings)
    if not found:
        return None
    best, middle = found[0], b.surface.points.mean(axis=0, keepdims=True)
    rivals_m = (each.score_m for each in found if is_elsewhere(each.T_a_b, best.T_a_b, middle))
    return best, best.score_m / max(least_rival_m, next(rivals_m, 0.0))


def parallel_headings(a: Submap, b: Submap) -> FloatArray:
    """Headings of b in a over half a turn at which many walls of both are parallel, modulo a right angle, shape (H,).

    A tenth of all headings in most buildings. Elsewhere no map lies like another one of the same building.
    """
    directions = []
    for normals in (a.surface.normals, b.surface.normals):
        turn = np.arctan2(normals[:, 1], normals[:, 0])[np.any(normals != 0.0, axis=1)]
        directions.append(fft.rfft(np.bincount(np.rint(np.degrees(turn)).astype(np.int64) % 90, minlength=90)))
    blur = np.exp(-2.0 * (np.pi * DIRECTION_DEG * np.arange(46) / 90.0) ** 2)
    parallel = fft.irfft(directions[0] * np.conj(directions[1]) * blur, 90)
    headings = _half_headings(min(_lever_m(a), _lever_m(b)))
    share = parallel[np.rint(np.degrees(headings)).astype(np.int64) % 90]
    chosen: FloatArray = headings[share >= PARALLEL_SHARE * share.max()]
    return chosen


def is_elsewhere(one: FloatArray, other: FloatArray, middle: FloatArray) -> bool:
    """Whether two transforms T_a_b put the middle (1, 2) of b at two places, or turn b differently."""
    gap = se2.transform(one, middle) - se2.transform(other, middle)
    turn = abs(se2.wrap_angle(one[2] - other[2]))
    return bool(np.linalg.norm(gap) > DISTINCT_M or turn > DISTINCT_RAD)


Drawing = tuple[FloatArray, FloatArray]
"""A map as points around the middle of its surface, metres: its surface, shape (N, 2), and the centres of its free
cells well away from any surface, shape (M, 2)."""


def _drawing(submap: Submap) -> tuple[Drawing, FloatArray]:
    free, points = submap.free, submap.surface.points
    surface = np.zeros_like(free)
    column, row = np.floor((points - submap.free_corner) / FREE_CELL_M).astype(np.int64).T
    surface[row, column] = True
    away = distance_transform_edt(~surface) * FREE_CELL_M > WELL_INSIDE_M
    rows, columns = np.nonzero(free & away)
    middle = points.mean(axis=0)
    inside = (np.column_stack((columns, rows)) + 0.5) * FREE_CELL_M + submap.free_corner - middle
    return (points - middle, inside), middle


def _coarse_peaks(a: Submap, b: Submap, headings: FloatArray | None = None) -> FloatArray:
    """T_a_b (K, 3) of the best positions for every heading and for half a turn farther, the best ones first.

    The score is a correlation of images: a cell of surface of one map counts by the cell of the other that it lies on,
    1 on a surface, blurred, and -``VIOLATION_WEIGHT`` in free space.
    """
    (one, middle_a), (other, middle_b) = _drawing(a), _drawing(b)
    drawn_a, reach_b_m = np.concatenate(one), float(np.hypot(*np.concatenate(other).T).max())
    # Every shift of b at which the images touch has a cell of its own, at its number modulo the sides of the image.
    least = np.floor((drawn_a.min(axis=0) - reach_b_m) / CELL_M)
    most = np.ceil((drawn_a.max(axis=0) + reach_b_m) / CELL_M)
    columns, rows = (fft.next_fast_len(int(extent) + 2, real=True) for extent in most - least)
    surface_a, inside_a = _spectra(one, 0.0, (rows, columns))
    worth = 2.0 * surface_a * _smear(rows, columns) - VIOLATION_WEIGHT * inside_a  # a surface counts for both maps
    against, product, near = VIOLATION_WEIGHT * surface_a, np.empty_like(surface_a), np.arange(-4, 5)
    found: list[tuple[float, float, int, int]] = []
    for heading in _half_headings(_lever_m(b)) if headings is None else headings:
        surface_b, inside_b = _spectra(other, heading, (rows, columns))
        for half in (0, 1):
            _correlate(worth, against, surface_b, inside_b, half == 1, product)
            scores = fft.irfft2(product, (rows, columns))
            for _ in range(PEAKS):
                row, column = divmod(int(np.argmax(scores)), columns)
                found.append((scores[row, column], heading + half * np.pi, column + half, row + half))
                scores[((row + near) % rows)[:, None], (column + near) % columns] = -np.inf
    score, heading_a_b, *cell = np.array(found).T
    shift = least + (np.column_stack(cell) - least) % (columns, rows)
    T_middle = np.column_stack((CELL_M * shift + middle_a, heading_a_b))
    return se2.compose(T_middle, np.append(-middle_b, 0.0))[np.argsort(-score, kind="stable")]


@njit(allocates=False)
def _correlate(worth, against, surface, inside, half, product):  # type: ignore[no-untyped-def]
    """Spectrum of the scores: W S* - A I* with the spectra S and I of a map, or those of the map turned by ``half``.

    Half a turn takes cell i to -1 - i, whose spectrum is the conjugate, shifted by a cell.
    """
    for row in range(product.shape[0]):
        for k in range(product.shape[1]):
            s, i = surface[row, k], inside[row, k]
            if not half:
                s, i = np.conj(s), np.conj(i)
            product[row, k] = worth[row, k] * s - against[row, k] * i


def _lever_m(submap: Submap) -> float:
    """Distance of the far walls of a map from its middle."""
    points = submap.surface.points
    return float(np.quantile(np.hypot(*(points - points.mean(axis=0)).T), 0.9))


def _half_headings(lever_m: float) -> FloatArray:
    """Headings over half a turn at which walls so far from the middle move by a cell and a half."""
    count = max(18, int(np.ceil(np.pi * lever_m / (1.5 * CELL_M))))
    return np.asarray(np.arange(count) * (np.pi / count), np.float64)


def _smear(rows: int, columns: int) -> NDArray[np.float32]:
    """Spectrum of a Gaussian that is 1 on a straight wall, shape (rows, columns // 2 + 1)."""
    y, x = np.meshgrid(fft.fftfreq(rows), fft.rfftfreq(columns), indexing="ij")
    spectrum: NDArray[np.float32] = np.exp(-2.0 * np.pi**2 * (x * x + y * y)).astype(np.float32)
    return spectrum * np.float32(np.sqrt(2.0 * np.pi))


def _spectra(drawing: Drawing, heading: float, shape: tuple[int, int]) -> tuple[Spectrum, Spectrum]:
    """Spectra of a turned map: of the cells with a surface, and of the free cells well away from any.

    Single precision is enough for peaks that are refined later, and takes two thirds of the time.
    """
    surface, inside = np.zeros((2, *shape), np.float32)
    for points, image in zip(drawing, (surface, inside), strict=True):
        _draw(points, heading, image)
    return fft.rfft2(surface), fft.rfft2(inside)


@njit(allocates=False)
def _draw(points, heading, image):  # type: ignore[no-untyped-def]
    """Set the cells of points (N, 2), turned by a heading, in a periodic image whose cell (0, 0) begins at 0."""
    cos, sin = np.cos(heading), np.sin(heading)
    rows, columns = image.shape
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        column = int(np.floor((cos * x - sin * y) / CELL_M))
        row = int(np.floor((sin * x + cos * y) / CELL_M))
        image[row % rows, column % columns] = 1.0
