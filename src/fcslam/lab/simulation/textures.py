"""Procedural textures of the simulated building: RGB images (height, width, 3), uint8, from a random generator."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

Image = NDArray[np.uint8]

_INK = np.array(
    [
        [196, 52, 44],
        [38, 82, 148],
        [236, 178, 48],
        [44, 118, 76],
        [28, 28, 34],
        [240, 236, 224],
        [122, 66, 130],
        [214, 118, 58],
        [70, 160, 172],
    ],
    dtype=np.float64,
)
_PLASTER = np.array([[222, 214, 196], [196, 208, 200], [214, 198, 178], [190, 200, 214], [226, 222, 214]], dtype=float)
_WOOD = np.array([[150, 104, 62], [112, 76, 48], [186, 146, 98], [92, 84, 78], [172, 170, 164]], dtype=np.float64)


def noise(shape: tuple[int, int], cells: int, rng: np.random.Generator) -> FloatArray:
    """Tileable value noise of the given shape with mean 0 and standard deviation about 0.3; ``cells`` bumps across."""
    grid = rng.normal(0.0, 0.5, (cells, cells))
    columns = _blend(np.arange(shape[1]) * cells / shape[1], grid)
    return _blend(np.arange(shape[0]) * cells / shape[0], columns.T).T


def plaster(rng: np.random.Generator, size: int = 512) -> Image:
    """A painted wall, 2.5 m high and wide: stains, scratches, a dark skirting board, sometimes a stripe."""
    paint = _PLASTER[rng.integers(len(_PLASTER))] + rng.normal(0.0, 6.0, 3)
    shade = (
        10.0 * noise((size, size), 5, rng) + 7.0 * noise((size, size), 40, rng) + 4.0 * rng.normal(size=(size, size))
    )
    image = paint + shade[..., None]
    for _ in range(30):
        row, column = rng.integers(0, size, 2)
        length, thick = rng.integers(4, 40), rng.integers(1, 4)
        image[row : row + thick, column : column + length] -= rng.uniform(10.0, 60.0)
    if rng.random() < 0.6:
        top = int(rng.uniform(0.5, 0.62) * size)
        image[top : top + size // 40] = 0.4 * image[top : top + size // 40] + 0.6 * _ink(rng)
    image[int(0.955 * size) :] *= 0.45
    return _image(image)


def planks(rng: np.random.Generator, size: int = 512) -> Image:
    """Wooden planks, for floors and sides of cupboards."""
    colour = _WOOD[rng.integers(len(_WOOD))]
    boards = int(rng.integers(5, 9))
    image = np.empty((size, size, 3))
    edges = np.linspace(0, size, boards + 1).astype(int)
    for low, high in pairwise(edges):
        grain = noise((high - low, size), 6, rng) + 0.6 * rng.normal(size=(high - low, 1))
        image[low:high] = colour + rng.normal(0.0, 10.0) + 16.0 * grain[..., None]
        image[low : low + 3] *= 0.55
        joint = int(rng.integers(0, size - 3))
        image[low:high, joint : joint + 3] *= 0.55
    return _image(image)


def tiles(rng: np.random.Generator, size: int = 512) -> Image:
    """A tiled floor with slightly different tiles."""
    count = int(rng.integers(5, 9))
    base = rng.uniform(110.0, 200.0) + rng.normal(0.0, 8.0, 3)
    tone = 14.0 * rng.normal(size=(count, count))
    index = np.arange(size) * count // size
    image = base + tone[index[:, None], index[None, :], None] + 8.0 * noise((size, size), 48, rng)[..., None]
    grout = np.flatnonzero(np.diff(index, prepend=-1))
    for offset in range(3):
        image[(grout + offset) % size] *= 0.6
        image[:, (grout + offset) % size] *= 0.6
    return _image(image)


def carpet(rng: np.random.Generator, size: int = 512) -> Image:
    """A carpet: fine noise and large stains."""
    stains = 22.0 * noise((size, size), 7, rng) + 14.0 * rng.normal(size=(size, size))
    return _image(0.5 * _ink(rng) + 50.0 + stains[..., None])


def cupboard(rng: np.random.Generator, size: int = 256) -> Image:
    """The front of a piece of furniture: boards, drawers or filled shelves."""
    image = planks(rng, size).astype(np.float64).transpose(1, 0, 2)
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    filled = rng.random() < 0.5
    for row in range(rows):
        for column in range(columns):
            top, bottom = (np.array([row, row + 1]) * size / rows + (7, -7)).astype(int)
            left, right = (np.array([column, column + 1]) * size / columns + (7, -7)).astype(int)
            if filled:
                image[top:bottom, left:right] *= 0.35
                _books(image[top:bottom, left:right], rng)
            else:
                image[top:bottom, left:right] *= rng.uniform(0.8, 1.2)
                y, x = (top + bottom) // 2, (left + right) // 2
                image[y : y + 5, x - 12 : x + 12] = 30.0
    return _image(image)


def picture(rng: np.random.Generator, height: int = 192, width: int = 256) -> Image:
    """A framed picture of random shapes, perhaps with lines of text."""
    image = np.tile(0.75 * _ink(rng) + 0.25 * _ink(rng), (height, width, 1))
    image += 18.0 * noise((height, width), 6, rng)[..., None]
    y, x = np.mgrid[:height, :width]
    for _ in range(int(rng.integers(5, 12))):
        cx, cy = rng.uniform(0.0, width), rng.uniform(0.0, height)
        a, b, turn = rng.uniform(8.0, 0.3 * width), rng.uniform(8.0, 0.3 * height), rng.uniform(0.0, np.pi)
        u = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        v = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        inside = (u / a) ** 2 + (v / b) ** 2 < 1.0 if rng.random() < 0.5 else (np.abs(u) < a) & (np.abs(v) < b)
        image[inside] = _ink(rng) + rng.normal(0.0, 10.0)
    if rng.random() < 0.5:
        _writing(image, rng)
    frame, colour = int(rng.integers(5, 11)), 0.35 * _ink(rng)
    image[:frame] = image[-frame:] = colour
    image[:, :frame] = image[:, -frame:] = colour
    return _image(image)


def door_sign(rng: np.random.Generator, size: int = 64) -> Image:
    """A small plate with a pattern of squares instead of a number."""
    cells = rng.random((6, 6)) < 0.5
    image = np.kron(np.where(cells, 30.0, 235.0), np.ones((size // 8, size // 8)))
    margin = (size - image.shape[0]) // 2
    plate = np.pad(image, margin, constant_values=235.0)
    return _image(np.repeat(plate[..., None], 3, axis=2))


def _books(shelf: FloatArray, rng: np.random.Generator) -> None:
    height, width = shelf.shape[:2]
    left = 0
    while left < width - 4:
        thick, free = int(rng.integers(4, 12)), int(rng.uniform(0.05, 0.4) * height)
        shelf[free:, left : left + thick] = _ink(rng) + rng.normal(0.0, 12.0)
        band = free + int(rng.integers(2, 12))
        shelf[band : band + 3, left : left + thick] = 230.0
        left += thick + int(rng.integers(0, 3))


def _writing(image: FloatArray, rng: np.random.Generator) -> None:
    """Draw lines of dark blocks, like words, on a light field."""
    height, width = image.shape[:2]
    top, left = int(rng.uniform(0.1, 0.5) * height), int(rng.uniform(0.08, 0.3) * width)
    field = image[top : int(0.92 * height), left : int(0.92 * width)]
    field[:] = 232.0
    for row in range(6, field.shape[0] - 10, int(rng.integers(10, 16))):
        column = 6
        while column < field.shape[1] - 12:
            word = int(rng.integers(5, 22))
            field[row : row + 5, column : min(column + word, field.shape[1] - 4)] = 40.0
            column += word + int(rng.integers(4, 8))


def _ink(rng: np.random.Generator) -> FloatArray:
    return np.asarray(_INK[rng.integers(len(_INK))])


def _blend(positions: FloatArray, grid: FloatArray) -> FloatArray:
    """Interpolate the columns of ``grid`` smoothly and periodically at ``positions`` (N,)."""
    left = np.floor(positions).astype(int)
    share = positions - left
    share = share * share * (3.0 - 2.0 * share)
    count = grid.shape[1]
    return np.asarray(grid[:, left % count] * (1.0 - share) + grid[:, (left + 1) % count] * share)


def _image(values: FloatArray) -> Image:
    return np.clip(values, 0.0, 255.0).astype(np.uint8)
