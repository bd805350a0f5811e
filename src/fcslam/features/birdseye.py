"""Binary features on the bird's-eye picture of a LiDAR submap.

The picture is a likelihood field: a wall is a smooth ridge of constant width, however densely it was sampled. Keypoints
are its corners (Shi and Tomasi 1994). A descriptor compares the picture at 256 pairs of points around the keypoint
(BRIEF, Calonder et al. 2010), rotated by the direction of the patch's intensity centroid (ORB, Rublee et al. 2011).
So it does not depend on the heading of the submap; the scale is known. OpenCV's own ORB aligned far fewer true pairs
of submaps: its patch covers only 1.5 m here, and FAST corners on smooth ridges depend on the sampling.

Column and row of the picture grow with x and y of the submap's coordinate frame.
"""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import assign, njit
from fcslam.features.codes import CODE_BITS
from fcslam.records import CODE_BYTES, Codes, FloatArray, frozen

DETECTOR_VERSION = "birdseye-brief-1"
"""Changes whenever the same points would give other descriptors, so with each of the numbers below."""

SIDE_M = 30.0
"""Side of the bird's-eye picture around the keyscan."""
_CELL_M = 0.1
_SIDE_CELLS = round(SIDE_M / _CELL_M)
_FIELD_SIGMA_M = 0.35
"""Standard deviation of the likelihood field around a wall."""
_PATCH_RADIUS_M = 1.5
"""Radius of the patch that a descriptor describes."""
_SUBCELLS = 4
"""Positions of a point are rounded to 1 / 4 of a cell."""

Picture = NDArray[np.uint8]


Features = tuple[NDArray[np.float32], Codes]
"""Keypoints of one submap, the strongest first, shape (K, 2): x, y in its coordinate frame; and their descriptors."""


def describe(points: FloatArray, most: int = 400) -> Features:
    """Detect and describe the ``most`` strongest features of a submap; K = 0 if the picture has no corner.

    The points (N, 2), metres in the submap's frame, are one per 5-10 cm of wall; those not in the picture are ignored.

    OpenCV's thread count is not changed, because it belongs to the whole process. The features do not depend on it.
    """
    picture = likelihood_picture(points)
    corners = cv2.goodFeaturesToTrack(picture, most, qualityLevel=0.003, minDistance=0, blockSize=3)
    if corners is None:
        return frozen(np.empty((0, 2)), np.float32), frozen(np.empty((0, CODE_BYTES)), np.uint8)
    pixels = corners.reshape(-1, 2).astype(np.int64)
    directions = _directions(picture, pixels, round(0.8 / _CELL_M))  # by the centroid of a disc of 0.8 m
    codes = np.packbits(_compare(picture, pixels, directions, _comparison_pattern()), axis=1)
    return frozen(pixels_to_metres(pixels), np.float32), frozen(codes, np.uint8)


def likelihood_picture(points: FloatArray, side: int = _SIDE_CELLS) -> Picture:
    """The likelihood field of points (N, 2), metres in the submap's coordinate frame, shape (side, side).

    It is ``255 exp(-d^2 / (2 sigma^2))`` with d the distance to the nearest point.
    """
    cells = points / _CELL_M + 0.5 * side
    inside = cells[((cells >= 0.0) & (cells < side)).all(axis=1)]
    picture: Picture = _stamp(inside, _likelihood_discs(), side)
    return picture


def pixels_to_metres(pixels: FloatArray | NDArray[np.int64]) -> FloatArray:
    """Convert picture coordinates (K, 2) to metres in the submap's coordinate frame.

    Pixel (0, 0) is the centre of the first cell.
    """
    metres: FloatArray = (pixels.astype(np.float64) + 0.5 - 0.5 * _SIDE_CELLS) * _CELL_M
    return metres


@cache
def _likelihood_discs() -> NDArray[np.uint8]:
    """The field around a point for every subcell position of the point: shape (S, S, width, width), y before x."""
    sigma_cells = _FIELD_SIGMA_M / _CELL_M
    reach = int(3.6 * sigma_cells) + 1  # beyond, the field is below half a grey level
    places = (np.arange(_SUBCELLS) + 0.5) / _SUBCELLS - 0.5
    squares = (np.arange(-reach, reach + 1) - places[:, None]) ** 2
    fields = np.exp(-0.5 * (squares[:, None, :, None] + squares[None, :, None, :]) / sigma_cells**2)
    return frozen(np.rint(255.0 * fields), np.uint8)


@cache
def _comparison_pattern() -> FloatArray:
    """Pairs of points in the patch, shape (4, 256): x, y, x', y' in cells.

    They follow the R-sequence of the generalised golden ratio in four dimensions (a low-discrepancy sequence), which
    covers the patch evenly and needs no random generator. Pairs that leave the patch are skipped.
    """
    golden = 1.0
    for _ in range(64):
        golden = (1.0 + golden) ** 0.2
    shortest, longest = 0.15, 0.75  # distance of two compared points, in radii of the patch
    steps = np.array([golden**-1, golden**-2, golden**-3, golden**-4])
    u = (0.5 + np.arange(1, 4 * CODE_BITS)[:, None] * steps) % 1.0
    start = np.sqrt(u[:, 0]) * np.exp(2j * np.pi * u[:, 1])
    end = start + (shortest + (longest - shortest) * u[:, 2]) * np.exp(2j * np.pi * u[:, 3])
    pairs = np.stack((start.real, start.imag, end.real, end.imag), axis=1)[np.abs(end) < 1.0]
    return frozen(np.ascontiguousarray(_PATCH_RADIUS_M / _CELL_M * pairs[:CODE_BITS].T))


@njit
def _stamp(cells: FloatArray, discs: NDArray[np.uint8], side: int) -> Picture:
    """Pixelwise maximum of the discs around ``cells`` (N, 2: column, row; whole numbers are corners of cells).

    The nearest point has the largest likelihood, so the result is the field of the distance transform, but with
    subcell resolution. It takes a tenth of the time, because few cells are occupied. A margin around the picture saves
    bound checks in the inner loop.
    """
    width = discs.shape[2]
    reach = width // 2
    padded = np.zeros((side + 2 * reach, side + 2 * reach), np.uint8)
    for index in range(cells.shape[0]):
        column, row = int(cells[index, 0]), int(cells[index, 1])
        disc = discs[int(_SUBCELLS * (cells[index, 1] - row)), int(_SUBCELLS * (cells[index, 0] - column))]
        for v in range(width):
            target, source = padded[row + v, column : column + width], disc[v]
            for u in range(width):
                target[u] = max(target[u], source[u])
    return padded[reach : reach + side, reach : reach + side].copy()


@njit
def _directions(picture: Picture, pixels: NDArray[np.int64], radius: int) -> FloatArray:
    """Direction [rad] from each pixel (K, 2) to the intensity centroid of a disc around it, shape (K,)."""
    directions = np.empty(pixels.shape[0])
    for index in range(pixels.shape[0]):
        column, row = pixels[index]
        moment_x = moment_y = np.int64(0)
        for v in range(max(-radius, -row), min(radius, picture.shape[0] - 1 - row) + 1):
            half = int(np.sqrt(radius * radius - v * v))
            for u in range(max(-half, -column), min(half, picture.shape[1] - 1 - column) + 1):
                level = np.int64(picture[row + v, column + u])
                moment_x += u * level
                moment_y += v * level
        directions[index] = np.arctan2(moment_y, moment_x)
    return directions


@njit
def _compare(
    picture: Picture, pixels: NDArray[np.int64], directions: FloatArray, pattern: FloatArray
) -> NDArray[np.bool_]:
    """Whether the first point of each rotated pair of ``pattern`` (4, 256) is darker, shape (K, 256).

    All cells of a keypoint are found before the first is read: that loop has no branch and so works on vectors.
    """
    rows, columns = picture.shape
    outside = rows * columns
    levels = np.zeros(outside + 1, np.uint8)  # the last one is that of the points outside
    assign(levels[:outside], picture.ravel())
    cells = np.empty((2, pattern.shape[1]), np.int32)
    darker = np.empty((pixels.shape[0], pattern.shape[1]), np.bool_)
    for index in range(pixels.shape[0]):
        column, row = pixels[index, 0] + 0.5, pixels[index, 1] + 0.5
        cos, sin = np.cos(directions[index]), np.sin(directions[index])
        for end in range(2):
            for bit in range(pattern.shape[1]):
                x, y = pattern[2 * end, bit], pattern[2 * end + 1, bit]
                u = np.int32(np.floor(column + cos * x - sin * y))
                v = np.int32(np.floor(row + sin * x + cos * y))
                inside = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
                cells[end, bit] = np.int32(v * columns + u) if inside else np.int32(outside)
        for bit in range(pattern.shape[1]):
            darker[index, bit] = levels[np.uint32(cells[0, bit])] < levels[np.uint32(cells[1, bit])]
    return darker
