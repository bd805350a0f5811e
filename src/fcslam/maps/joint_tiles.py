"""Maps as square tiles that travel to robots: a robot gets the tiles that changed since its last request.

A tile has ``TILE`` by ``TILE`` cells, four to a byte, compressed by zstd. Tile (0, 0) begins at the origin of ``map``.
"""

import hashlib
import json
import secrets
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from fcslam.maps.occupancy_map import Cells, Occupancy, OccupancyMap
from fcslam.untrusted import zstd

TILE: Final = 64
"""Cells on each side."""
_PACKED: Final = TILE * TILE // 4
_SHIFTS: Final = np.arange(0, 8, 2, dtype=np.uint8)
LARGEST_GRID: Final = 64_000_000
"""Cells of a map that a robot puts together; more are refused."""
LARGEST_ANSWER: Final = 1_000_000
"""Bytes of the tiles of one answer; a request for more is refused."""
_EMPTY: Final = b""

Number = tuple[int, int]
"""Row and column of a tile."""


class TileBatch(NamedTuple):
    """An answer to a robot."""

    frame: str
    """Identifies the history of tiles, with one coordinate frame and resolution; in another, earlier tiles are void."""
    version: int
    """Version of the newest change that the robot has with these tiles."""
    resolution_m: float
    is_complete: bool
    """Whether there is nothing more to fetch."""
    tiles: Mapping[Number, bytes]
    """Compressed tiles by number; an empty one has no known cell."""

    def encode(self) -> bytes:
        """As bytes: a line of JSON with the sizes of the tiles, then their contents."""
        sizes = [[*number, len(data)] for number, data in self.tiles.items()]
        head = {
            "frame": self.frame,
            "version": self.version,
            "resolution": self.resolution_m,
            "complete": self.is_complete,
            "tiles": sizes,
        }
        return json.dumps(head, separators=(",", ":")).encode() + b"\n" + b"".join(self.tiles.values())


def decode_batch(data: bytes) -> TileBatch:
    """Read what ``TileBatch.encode`` wrote.

    Raises:
        ValueError: it is something else.
    """
    line, _, body = data.partition(b"\n")
    try:
        head = json.loads(line)
        tiles, at = {}, 0
        for row, column, size in head["tiles"]:
            if not (isinstance(size, int) and 0 <= size <= len(body) - at):
                raise ValueError(f"a tile of {size!r} bytes")
            tiles[int(row), int(column)] = body[at : at + size]
            at += size
        resolution_m = float(head["resolution"])
        if at != len(body) or not 1e-3 <= resolution_m <= 100.0:
            raise ValueError("sizes do not add up")
        return TileBatch(str(head["frame"]), int(head["version"]), resolution_m, bool(head["complete"]), tiles)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"these are not tiles of a map: {error}") from error


class TileHistory:
    """The tiles of one map and when each changed last."""

    def __init__(self) -> None:
        self._tag = secrets.token_hex(4)  # versions of two histories of one frame must not be compared
        self.frame = ""
        self._version = 0
        self._resolution_m = 1.0
        self._tiles: dict[Number, tuple[int, bytes]] = {}
        """Version of the last change and content, in the order of these versions."""

    def update(self, frame: str, occupancy: OccupancyMap) -> None:
        """Take the map as it is now; ``frame`` identifies its coordinate frame and resolution."""
        frame += self._tag
        if frame != self.frame:
            self.frame, self._tiles, self._version = frame, {}, 0
        self._resolution_m = occupancy.resolution_m
        found = dict(_tiles_of(occupancy))
        for number in [*found, *(self._tiles.keys() - found.keys())]:
            data = found.get(number, _EMPTY)
            if number not in self._tiles or self._tiles[number][1] != data:
                self._version += 1
                self._tiles.pop(number, None)
                self._tiles[number] = self._version, data

    def since(self, frame: str, version: int, limit_bytes: int) -> TileBatch:
        """The changes that a robot lacks, the oldest first, at least one and no more than a number of bytes."""
        if frame != self.frame or version > self._version:
            version = 0
        chosen: dict[Number, bytes] = {}
        size = 0
        for number, (changed, data) in self._tiles.items():
            if changed <= version:
                continue
            if chosen and size + len(data) > limit_bytes:
                return TileBatch(self.frame, version, self._resolution_m, False, chosen)
            chosen[number], version = data, changed
            size += len(data)
        return TileBatch(self.frame, self._version, self._resolution_m, True, chosen)


class TiledMap:
    """The map that a robot puts together of tiles."""

    def __init__(self) -> None:
        self.frame, self.version = "", 0
        self._resolution_m = 1.0
        self._tiles: dict[Number, Cells] = {}

    def add(self, batch: TileBatch) -> None:
        """Take the next tiles.

        Raises:
            ValueError: a tile is broken, or the map would be too large; nothing is taken.
        """
        added = {number: _unpacked(data) for number, data in batch.tiles.items()}
        before = self._tiles if batch.frame == self.frame else {}
        tiles = {number: cells for number, cells in {**before, **added}.items() if cells is not None}
        if tiles and np.prod(np.ptp(np.array(list(tiles)), axis=0) + 1.0) * TILE * TILE > LARGEST_GRID:
            raise ValueError(f"a map of more than {LARGEST_GRID} cells")
        self.frame, self.version = batch.frame, batch.version
        self._resolution_m, self._tiles = batch.resolution_m, tiles

    def occupancy(self) -> OccupancyMap | None:
        """The map, in whole tiles; None before the first tile."""
        return tiled_map(self._tiles, self._resolution_m) if self._tiles else None


def tiled_map(tiles: Mapping[Number, Cells], resolution_m: float) -> OccupancyMap:
    """The map of square tiles of one size by number, at least one; tile (0, 0) begins at the origin."""
    side, numbers = len(next(iter(tiles.values()))), np.array(list(tiles))
    first, (rows, columns) = numbers.min(axis=0), np.ptp(numbers, axis=0) + 1
    cells = np.zeros((rows * side, columns * side), np.uint8)
    for number, tile in tiles.items():
        row, column = side * (np.array(number) - first)
        cells[row : row + side, column : column + side] = tile
    row, column = (float(edge) for edge in first * side * resolution_m)
    return OccupancyMap(cells, resolution_m, (column, row))


def _tiles_of(occupancy: OccupancyMap) -> Iterator[tuple[Number, bytes]]:
    whole = padded(occupancy)
    first = [round(edge / whole.resolution_m / TILE) for edge in whole.origin_xy[::-1]]
    rows, columns = (size // TILE for size in whole.cells.shape)
    for i, j in np.ndindex(rows, columns):
        cells = whole.cells[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE]
        if cells.any():
            packed = np.bitwise_or.reduce(cells.reshape(-1, 4) << _SHIFTS, axis=1, dtype=np.uint8)
            yield (first[0] + i, first[1] + j), zstd.compress(packed.tobytes(), 9)


def _unpacked(data: bytes) -> Cells | None:
    if not data:
        return None
    try:
        packed = zstd.ZstdDecompressor().decompress(data, _PACKED + 1)
    except (zstd.ZstdError, EOFError) as error:
        raise ValueError(f"a broken tile: {error}") from error
    if len(packed) != _PACKED:
        raise ValueError(f"a tile of {len(packed)} bytes")
    cells: Cells = (np.frombuffer(packed, np.uint8)[:, None] >> _SHIFTS & 3).astype(np.uint8).reshape(TILE, TILE)
    if cells.max() > max(Occupancy):
        raise ValueError("a cell with an unknown state")
    return cells


def padded(occupancy: OccupancyMap) -> OccupancyMap:
    """The map in whole tiles, so that its extent seldom changes while it grows."""
    side = occupancy.resolution_m
    column, row = (round(edge / side) for edge in occupancy.origin_xy)
    height, width = occupancy.cells.shape
    low, high = np.array((row, column)) // TILE * TILE, -(-np.array((row + height, column + width)) // TILE) * TILE
    cells = np.zeros(tuple(high - low), np.uint8)
    below, left = np.array((row, column)) - low
    cells[below : below + height, left : left + width] = occupancy.cells
    return OccupancyMap(cells, side, (float(low[1]) * side, float(low[0]) * side), occupancy.floor)


def frame_of(origin: Sequence[float], session: str, resolution_m: float) -> str:
    """Identifies a frame by the session that begins it, by about the pose (x, y, theta) where it begins, and by the
    resolution of the grid. Where a user placed the map, each solution moves that pose a little; the frame stays."""
    x, y, theta = origin
    text = f"{session} {round(x) + 0} {round(y) + 0} {round(theta, 1) + 0.0:.1f} {resolution_m:g}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]
