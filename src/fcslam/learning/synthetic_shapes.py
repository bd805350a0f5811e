"""Synthetic shapes: pictures whose corners are known because they were drawn there.

The families are SuperPoint's (DeTone et al. 2018): lines, polygons, several polygons, stars, stripes, checkerboards,
cubes, and, without any corner, ellipses and noise. A detector trained on them alone finds corners in real images too.
Everything is drawn twice as large as it is wanted and shrunk, so that corners lie between pixels.
"""

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np

from fcslam.features.detector import GreyImage
from fcslam.learning.labels import Labels
from fcslam.records import FloatArray

OVERSIZE: Final = 2
LEAST_CONTRAST: Final = 35
"""Grey levels between a shape and what it stands on."""

Drawer = Callable[[GreyImage, np.random.Generator], FloatArray]
"""Draws on a picture and returns its corners, shape (N, 2), in the picture's own pixels."""


def draw_shapes(width: int, height: int, rng: np.random.Generator) -> tuple[GreyImage, Labels]:
    """One picture of a random family, and its corners."""
    picture = background(OVERSIZE * width, OVERSIZE * height, rng)
    corners = FAMILIES[int(rng.integers(len(FAMILIES)))](picture, rng)
    blur = 2 * int(rng.integers(0, 3)) + 1
    picture = np.asarray(cv2.GaussianBlur(picture, (blur, blur), 0), np.uint8)
    shrunk = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    # The middle of a picture's first pixel is (0, 0) before and after.
    places = (corners + 0.5) / OVERSIZE - 0.5
    inside = ((places >= 0.0) & (places <= [width - 1.0, height - 1.0])).all(axis=1)
    kept = places[inside].astype(np.float32)
    return shrunk, Labels(kept, np.ones(len(kept), np.float32))


def background(width: int, height: int, rng: np.random.Generator) -> GreyImage:
    """Blots of one grey level's neighbourhood, blurred until no corner is left."""
    level = int(rng.integers(20, 236))
    picture = np.full((height, width), level, np.uint8)
    for _ in range(int(rng.integers(0, 30))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        shade = int(np.clip(level + rng.integers(-40, 41), 0, 255))
        cv2.circle(picture, centre, int(rng.integers(8, max(width // 5, 9))), shade, -1)
    side = 2 * (min(width, height) // 8) + 1
    return np.asarray(cv2.blur(picture, (side, side)), np.uint8)


def lines(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """Straight lines that do not cross; their ends count."""
    height, width = picture.shape
    ends: list[FloatArray] = []
    for _ in range(int(rng.integers(1, 9))):
        line = rng.uniform([0, 0], [width, height], (2, 2))
        if np.linalg.norm(line[1] - line[0]) < 0.1 * width or any(_cross(line, other) for other in ends):
            continue
        thickness = int(rng.integers(2, max(height // 30, 3)))
        cv2.line(picture, *_whole(line), _contrasting(picture, rng), thickness, cv2.LINE_AA)
        ends.append(np.rint(line))
    return np.concatenate(ends) if ends else np.empty((0, 2))


def polygon(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """One filled convex polygon of three to seven corners."""
    height, width = picture.shape
    radius = rng.uniform(0.15, 0.45) * min(width, height)
    return _polygon(picture, rng, rng.uniform([radius, radius], [width - radius, height - radius]), radius)


def polygons(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """Several polygons apart from each other."""
    height, width = picture.shape
    circles: list[tuple[FloatArray, float]] = []
    corners = [np.empty((0, 2))]
    for _ in range(30):
        radius = rng.uniform(0.06, 0.2) * min(width, height)
        centre = rng.uniform([radius, radius], [width - radius, height - radius])
        if all(np.linalg.norm(centre - other) > radius + reach for other, reach in circles):
            circles.append((centre, radius))
            corners.append(_polygon(picture, rng, centre, radius))
    return np.concatenate(corners)


def star(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """Rays from one point; it counts and so do their ends."""
    height, width = picture.shape
    count = int(rng.integers(3, 8))
    centre = np.rint(rng.uniform([0.3 * width, 0.3 * height], [0.7 * width, 0.7 * height]))
    angles = _spread_angles(count, rng)
    length = rng.uniform(0.15, 0.5, (count, 1)) * min(width, height)
    ends = np.rint(centre + length * np.stack((np.cos(angles), np.sin(angles)), axis=1))
    thickness = int(rng.integers(2, max(height // 40, 3)))
    shade = _contrasting(picture, rng)
    for end in ends:
        cv2.line(picture, *_whole(np.stack((centre, end))), shade, thickness, cv2.LINE_AA)
    return np.concatenate((centre[None], ends))


def stripes(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """Parallel bars of many shades across a tilted rectangle; the ends of their borders count."""
    columns = int(rng.integers(4, 12))
    steps = np.concatenate(([0.0], np.cumsum(rng.uniform(0.5, 1.5, columns))))
    grid = np.stack(np.meshgrid(steps / steps[-1], [0.0, 1.0]), axis=-1)
    return _tiles(picture, grid, rng)


def checkerboard(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """A board of many shades seen from the side; every crossing counts."""
    rows, columns = rng.integers(3, 8, 2)
    grid = np.stack(np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1)), axis=-1)
    return _tiles(picture, grid, rng)


def cube(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """A box of which three faces are seen; its seven visible corners count."""
    height, width = picture.shape
    angles = rng.uniform([0.15, 0.15], [np.pi / 2 - 0.15, 0.9])
    turn = np.array([[np.cos(angles[0]), -np.sin(angles[0])], [np.sin(angles[0]), np.cos(angles[0])]])
    sides = rng.uniform(0.15, 0.4, 3) * min(width, height)
    across = turn * sides[:2, None] * [1.0, np.sin(angles[1])]
    up = np.array([0.0, -sides[2] * np.cos(angles[1])])
    # Both horizontal edges leave the nearest corner, away from who looks: up in the picture.
    right, left = across[0] * [1.0, -1.0], np.array([-abs(across[1][0]), -abs(across[1][1])])
    near = np.zeros(2)
    faces = [
        np.stack((near, right, right + up, near + up)),
        np.stack((near, left, left + up, near + up)),
        np.stack((up, up + right, up + right + left, up + left)),
    ]
    corners = np.concatenate((np.stack((near, right, left)), np.stack((up, up + right, up + left, up + right + left))))
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    room = 0.5 * np.ptp(corners, axis=0)
    place = rng.uniform(room, np.maximum([width, height] - room, room + 1.0)) - middle
    for face, shade in zip(faces, _shades(3, picture, rng), strict=True):
        cv2.fillConvexPoly(picture, np.rint(face + place).astype(np.int32), shade, cv2.LINE_AA)
    placed: FloatArray = np.rint(corners + place)
    return placed


def ellipses(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """Filled ellipses: no corner anywhere."""
    height, width = picture.shape
    for _ in range(int(rng.integers(1, 12))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.integers(height // 20, height // 4)), int(rng.integers(height // 20, height // 4)))
        shade = _contrasting(picture, rng)
        cv2.ellipse(picture, centre, axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
        picture[:] = cv2.GaussianBlur(picture, (5, 5), 0)
    return np.empty((0, 2))


def noise(picture: GreyImage, rng: np.random.Generator) -> FloatArray:
    """Nothing but noise: no corner either."""
    picture[:] = rng.integers(0, 256, picture.shape, dtype=np.uint8)
    return np.empty((0, 2))


FAMILIES: Final[tuple[Drawer, ...]] = (
    lines,
    polygon,
    polygons,
    star,
    stripes,
    checkerboard,
    checkerboard,
    cube,
    ellipses,
    noise,
)


def _polygon(picture: GreyImage, rng: np.random.Generator, centre: FloatArray, radius: float) -> FloatArray:
    """A convex polygon on a circle; corners so flat that nobody sees them are not drawn."""
    angles = _spread_angles(int(rng.integers(3, 7)), rng)
    corners = np.rint(centre + radius * np.stack((np.cos(angles), np.sin(angles)), axis=1))
    cv2.fillConvexPoly(picture, corners.astype(np.int32), _contrasting(picture, rng), cv2.LINE_AA)
    return corners


def _spread_angles(count: int, rng: np.random.Generator) -> FloatArray:
    """Directions all around, neighbours never close."""
    return (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * (2.0 * np.pi / count) + rng.uniform(0.0, 2.0 * np.pi)


def _tiles(picture: GreyImage, grid: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Quadrilaterals between the crossings of a grid (R, C, 2) in [0, 1], laid tilted over the picture."""
    height, width = picture.shape
    size = np.array([width, height], np.float64)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    target = (0.15 + 0.7 * square + rng.uniform(-0.13, 0.13, (4, 2))) * size
    turn = cv2.getRotationMatrix2D((0.5 * width, 0.5 * height), float(rng.uniform(0, 360)), 1.0)
    target = target @ turn[:, :2].T + turn[:, 2]
    homography = cv2.getPerspectiveTransform(square, target.astype(np.float32))
    crossings = np.rint(cv2.perspectiveTransform(grid.reshape(1, -1, 2), homography)).reshape(grid.shape)
    rows, columns = grid.shape[0] - 1, grid.shape[1] - 1
    for row in range(rows):
        shades = _shades(columns, picture, rng)
        for column in range(columns):
            ring = crossings[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
            shade = shades[column] if (row + column) % 2 else 255 - shades[column] // 3
            cv2.fillConvexPoly(picture, ring.astype(np.int32), int(shade), cv2.LINE_AA)
    corners: FloatArray = crossings.reshape(-1, 2)
    return corners


def _contrasting(picture: GreyImage, rng: np.random.Generator) -> int:
    """A shade unlike the picture's mean."""
    mean = float(picture.mean())
    while True:
        shade = int(rng.integers(0, 256))
        if abs(shade - mean) > LEAST_CONTRAST:
            return shade


def _shades(count: int, picture: GreyImage, rng: np.random.Generator) -> list[int]:
    """Shades of which neighbours differ."""
    shades = [_contrasting(picture, rng)]
    while len(shades) < count:
        shade = int(rng.integers(0, 256))
        if abs(shade - shades[-1]) > LEAST_CONTRAST:
            shades.append(shade)
    return shades


def _whole(line: FloatArray) -> tuple[list[int], list[int]]:
    start, end = np.rint(line).astype(int).tolist()
    return start, end


def _cross(a: FloatArray, b: FloatArray) -> bool:
    """Whether two segments (2, 2) come within reach of each other's sides."""

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    apart = side(a[0], a[1], b[0]) * side(a[0], a[1], b[1]) > 0 or side(b[0], b[1], a[0]) * side(b[0], b[1], a[1]) > 0
    return not apart
