from dataclasses import replace

import cv2
import numpy as np
import pytest

from fcslam.maps import palette
from fcslam.maps.drawing import (
    CLOSURE,
    CLOSURES_APART_M,
    FLOOR,
    INK,
    LINE_HEIGHT_PX,
    LONG_SIDE_PX,
    PAPER,
    WALL,
    map_png,
    round_length,
)
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap

pytestmark = pytest.mark.slow

SIDE_M = 0.05
ROBOTS = tuple((rgb & 255, rgb >> 8 & 255, rgb >> 16) for rgb in palette.ROBOTS)


def walled(height, width, origin_xy=(-3.0, 2.0), resolution_m=SIDE_M):
    """A free hall with walls one cell thick, in the middle of unknown area as wide as a quarter of it."""
    cells = np.full((height, width), Occupancy.UNKNOWN, np.uint8)
    hall = cells[height // 6 : -(height // 6), width // 6 : -(width // 6)]
    hall[:] = Occupancy.OCCUPIED
    hall[1:-1, 1:-1] = Occupancy.FREE
    return OccupancyMap(cells, resolution_m, origin_xy)


def seen(png):
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


def codes(image):
    """One number per pixel."""
    return image @ np.array((1, 256, 65536))


def where(image, color):
    return np.argwhere(codes(image) == codes(np.array(color)))


def way(*points):
    return np.array([(x, y, 0.0) for x, y in points])


@pytest.mark.parametrize("shape", [(60, 90), (300, 500), (700, 800), (3000, 1400), (4000, 5000)])
def test_the_long_side_is_about_1600_pixels_and_walls_are_crisp(shape):
    image = seen(map_png(walled(*shape), {}))
    assert 0.6 * LONG_SIDE_PX < max(image.shape) < 1.6 * LONG_SIDE_PX
    walls = where(image, WALL)
    top, left = walls.min(axis=0)
    bottom, right = walls.max(axis=0)
    hall = image[top : bottom + 1, left : right + 1]
    assert set(np.unique(codes(hall))) == {codes(np.array(color)) for color in (WALL, FLOOR)}
    for edge in (hall[0], hall[-1], hall[:, 0], hall[:, -1]):
        assert (edge == WALL).all()
    assert (image[0] == PAPER).all()


def test_trajectories_lie_on_the_map_with_y_up():
    fused = walled(120, 180)  # the hall spans x -1.5 .. 4.5, y 3 .. 7
    image = seen(map_png(fused, {"robot_1": way((-1.0, 3.5), (4.0, 3.5)), "robot_2": way((4.0, 6.5), (3.0, 6.5))}))
    top, left = where(image, WALL).min(axis=0)
    bottom, right = where(image, WALL).max(axis=0)

    def pixel(x, y):
        u, v = (x + 1.5) / 6.0, (7.0 - y) / 4.0
        return round(left + u * (right - left)), round(top + v * (bottom - top))

    for color, x, y in ((ROBOTS[0], -1.0, 3.5), (ROBOTS[0], 2.0, 3.5), (ROBOTS[1], 4.0, 6.5), (ROBOTS[1], 3.5, 6.5)):
        column, row = pixel(x, y)
        patch = image[row - 1 : row + 2, column - 1 : column + 2]
        assert len(where(patch, color)) > 0, (x, y)
    start, end = (pixel(x, 3.5) for x in (-1.0, 4.0))
    dots = [
        len(where(image[row - 12 : row + 13, column - 12 : column + 13], ROBOTS[0])) for column, row in (start, end)
    ]
    assert dots[0] > 2 * dots[1]


def test_closures_between_robots_are_drawn():
    fused, ways = walled(120, 180), {"a": way((0, 4), (1, 4)), "b": way((0, 6), (1, 6))}
    bare = map_png(fused, ways)
    shared = np.array(((0.5, 4.0), (0.5, 6.0)))
    assert len(where(seen(bare), CLOSURE)) == 0
    assert len(where(seen(map_png(fused, ways, [shared])), CLOSURE)) > 100


def test_of_very_many_closures_the_shortest_that_lie_apart_are_drawn():
    fused, ways = walled(120, 300, (0.0, 0.0), 0.5), {"a": way((30, 15), (120, 15)), "b": way((30, 45), (120, 45))}
    generator = np.random.default_rng(0)
    starts = generator.uniform((0.0, 0.0), (150.0, 60.0), (4_000, 2))
    ends = starts + generator.normal(size=starts.shape)
    closures = list(np.stack((starts, ends), axis=1))
    all_of_them = seen(map_png(fused, ways, closures))

    middles, kept = np.empty((0, 2)), []
    for closure in sorted(closures, key=lambda ends: np.linalg.norm(ends[1] - ends[0])):
        middle = closure.mean(axis=0)
        if (np.linalg.norm(middles - middle, axis=1) > CLOSURES_APART_M).all():
            middles, kept = np.vstack((middles, middle)), [*kept, closure]
    above_legend = slice(-2 * LINE_HEIGHT_PX)
    assert 1000 < len(kept) < 3000
    assert np.array_equal(all_of_them[above_legend], seen(map_png(fused, ways, kept))[above_legend])


def test_the_scale_bar_is_as_long_as_it_says():
    image = seen(map_png(walled(300, 600), {}))
    walls = where(image, WALL)
    pixels_per_m = (walls[:, 1].max() - walls[:, 1].min() + 1) / (400 * SIDE_M)
    longest_row_px = np.bincount(where(image, INK)[:, 0]).max()
    assert abs(longest_row_px / pixels_per_m - 2.0) < 0.1


def test_beams_through_a_window_do_not_widen_the_picture():
    fused = walled(120, 180)
    cells = fused.cells.copy()
    cells[60, 160:] = Occupancy.FREE
    beyond = replace(fused, cells=cells)
    assert seen(map_png(beyond, {})).shape == seen(map_png(fused, {})).shape


def test_a_robot_outside_the_known_area_is_shown():
    fused = walled(120, 180)
    image = seen(map_png(fused, {"a": way((-2.5, 2.3), (-2.5, 2.6))}))
    assert len(where(image[:-80], ROBOTS[0])) > 50


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        way((0, 4)),
        way((np.nan, 4), (np.inf, -np.inf), (1, 5)),
        np.full((4, 3), np.nan),
        way((0, 4), (1e300, -1e300), (-1e12, 5)),
    ],
)
def test_odd_trajectories_do_no_harm(points):
    closure = np.array(((np.nan, 0.0), (1e200, 5.0)))
    assert seen(map_png(walled(120, 180), {"a": points}, [closure])).size > 0


def test_many_robots_with_long_names_fit_into_the_legend():
    few = seen(map_png(walled(120, 180), {"a": way((0, 4), (1, 4))}))
    ways = {f"robot number {k} of the long corridor ŝ": way((0, 4), (1, 4 + 0.1 * k)) for k in range(20)}
    many = seen(map_png(walled(120, 180), ways))
    assert many.shape[1] == few.shape[1]
    assert many.shape[0] > few.shape[0] + 100
    assert len(where(many[:, -1:], PAPER)) == many.shape[0]


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (900, 1)])
def test_a_map_of_nothing_is_still_a_picture(shape):
    empty = OccupancyMap(np.zeros(shape, np.uint8), SIDE_M, (0.0, 0.0))
    image = seen(map_png(empty, {}))
    assert len(where(image, PAPER)) > 0.9 * image.shape[0] * image.shape[1]


@pytest.mark.parametrize(("given", "expected"), [(0.99, 0.5), (1.0, 1.0), (4.99, 2.0), (7.3, 5.0), (123.0, 100.0)])
def test_lengths_are_rounded_down_to_1_2_5(given, expected):
    assert round_length(given) == pytest.approx(expected)


def test_a_robot_has_one_colour_whoever_else_is_there():
    alone = palette.robot_colors(["robot_2"])["robot_2"]
    fleet = palette.robot_colors(["robot_1", "robot_2", "robot_2+1", "robot_3"])
    assert fleet["robot_2"] == fleet["robot_2+1"] == alone
    assert len(set(fleet.values())) == 3
    names = [f"{letter}{k}" for letter in "ab" for k in range(1, 5)]
    assert len(set(palette.robot_colors(names).values())) == 8, "names that want one colour get different ones"
    assert len(palette.robot_colors([f"r{k}" for k in range(30)])) == 30
