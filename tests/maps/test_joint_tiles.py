"""Maps as tiles: whoever follows the changes has the map, however little comes at once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.maps.joint_tiles import TILE, TileBatch, TiledMap, TileHistory, decode_batch, frame_of, padded
from fcslam.maps.occupancy_map import OccupancyMap


def occupancy(seed, height, width, column, row):
    cells = np.random.default_rng(seed).integers(0, 3, (height, width), dtype=np.uint8)
    return OccupancyMap(cells, 0.05, (0.05 * column, 0.05 * row))


def known_cells(one):
    """Global row and column of every known cell, and its state."""
    column, row = (round(edge / one.resolution_m) for edge in one.origin_xy)
    return {(row + y, column + x): one.cells[y, x] for y, x in zip(*np.nonzero(one.cells), strict=True)}


def fetch(history, tiled, limit=10**6):
    """Follow until nothing is left; returns the number of answers."""
    for count in range(1, 1000):
        tiled.add(decode_batch(history.since(tiled.frame, tiled.version, limit).encode()))
        if tiled.version == history.since("", 0, 10**9).version:
            return count
    raise AssertionError("it never ends")


@given(st.lists(st.tuples(st.integers(1, 150), st.integers(1, 150), st.integers(-200, 200), st.integers(-200, 200)),
                min_size=1, max_size=3), st.integers(1, 3000))  # fmt: skip
@settings(max_examples=25, deadline=None)
def test_who_follows_has_the_newest_map(shapes, limit):
    history, tiled = TileHistory(), TiledMap()
    for seed, shape in enumerate(shapes):
        newest = occupancy(seed, *shape)
        history.update("frame", newest)
        fetch(history, tiled, limit)
        got = tiled.occupancy()
        assert (known_cells(got) if got else {}) == known_cells(newest)


def test_only_tiles_that_changed_travel_and_no_more_than_the_limit():
    history, tiled = TileHistory(), TiledMap()
    first = occupancy(0, 4 * TILE, 4 * TILE, 0, 0)
    history.update("frame", first)
    whole = history.since("", 0, 10**6)
    assert len(whole.tiles) == 16
    each = len(whole.tiles[0, 0])
    assert fetch(history, tiled, 2 * each) >= 8
    cells = first.cells.copy()
    cells[TILE + 3, 2 * TILE + 5] = (cells[TILE + 3, 2 * TILE + 5] + 1) % 3
    history.update("frame", OccupancyMap(cells, 0.05, first.origin_xy))
    assert list(history.since(tiled.frame, tiled.version, 10**6).tiles) == [(1, 2)]


def test_in_another_frame_earlier_tiles_count_no_longer():
    history, tiled = TileHistory(), TiledMap()
    history.update("one", occupancy(0, 70, 70, 0, 0))
    fetch(history, tiled)
    newest = occupancy(1, 10, 10, 500, 500)
    history.update("another", newest)
    fetch(history, tiled)
    assert known_cells(tiled.occupancy()) == known_cells(newest)


def test_versions_of_another_history_of_the_same_frame_count_no_longer():
    before, after, tiled = TileHistory(), TileHistory(), TiledMap()
    before.update("frame", occupancy(0, 3 * TILE, 70, 0, 0))
    fetch(before, tiled)
    newest = occupancy(1, 4 * TILE, 70, 0, 0)
    after.update("frame", newest)
    fetch(after, tiled)
    assert known_cells(tiled.occupancy()) == known_cells(newest)


def test_a_placed_map_keeps_its_frame_when_a_solution_moves_it_a_little():
    frame = frame_of((3.0, -0.0, 0.0), "a", 0.05)
    assert frame_of((3.004, 0.003, -0.0008), "a", 0.05) == frame
    others = [((7.0, 0.0, 0.0), "a", 0.05), ((3.0, 0.0, 0.5), "a", 0.05), ((3.0, 0.0, 0.0), "b", 0.05),
              ((3.0, 0.0, 0.0), "a", 0.1)]  # fmt: skip
    assert frame not in {frame_of(*other) for other in others}


HEAD = b'{"frame":"a","version":1,"resolution":0.05,"complete":true,"tiles":[]}'


@pytest.mark.parametrize("data", [
    b"", b"[]", b"[" * 100_000, HEAD.replace(b"[]", b"[[0,0,9]]") + b"\nabc", HEAD.replace(b"[]", b"[[0,0,-1]]"),
    HEAD.replace(b"[]", b"[[1e999,0,0]]"), HEAD.replace(b"1,", b"1e999,"), HEAD.replace(b"0.05", b"-1"),
    HEAD.replace(b"0.05", b"1" + b"0" * 400),
])  # fmt: skip
def test_what_is_no_batch_is_refused(data):
    assert decode_batch(HEAD).is_complete
    with pytest.raises(ValueError, match="not tiles of a map"):
        decode_batch(data)


def test_a_broken_tile_and_a_map_without_end_are_refused_and_nothing_changes():
    history, tiled = TileHistory(), TiledMap()
    history.update("frame", occupancy(0, 10, 10, 0, 0))
    fetch(history, tiled)
    before = known_cells(tiled.occupancy())
    tile = next(iter(history.since("", 0, 10**6).tiles.values()))
    for tiles in ({(0, 0): b"no zstd"}, {(10**6, 10**6): tile}):
        with pytest.raises(ValueError, match=r"a (broken tile|map of more than)"):
            tiled.add(TileBatch(tiled.frame, 9, 0.05, True, tiles))
        assert known_cells(tiled.occupancy()) == before


def test_padding_adds_unknown_cells_only():
    one = occupancy(0, 50, 90, -13, 77)
    whole = padded(one)
    assert not (np.array(whole.cells.shape) % TILE).any()
    assert known_cells(whole) == known_cells(one)
