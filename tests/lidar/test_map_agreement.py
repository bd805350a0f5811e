"""Local maps of one place agree as well as the halves of one robot's scans; those of another place do not."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.map_agreement import NOISE_M, WALL_M, Noise, compare, local_map, noise_of, total
from tests.flats import BACK, ROUND, flat, lookalike
from tests.lidar.worlds import box, drive, path, scan_at

pytestmark = pytest.mark.slow
HERE = np.zeros(3)


def seen(segments, waypoints, seed, noise_m=0.012):
    """The local map of a drive; its frame is that of the drawing."""
    poses, rng = drive(waypoints, step_m=0.4, step_rad=0.5), np.random.default_rng(seed)
    return local_map([(scan_at(pose, segments, noise_m=noise_m, rng=rng), pose) for pose in poses], 14.0)


def compared(one, other, T):
    return compare(one, other, T, Noise(*map(max, zip(noise_of([one]), noise_of([other]), strict=True))))


@pytest.mark.parametrize("noise_m", [0.005, 0.015, 0.03])
def test_one_place_is_as_likely_as_it_should_be_whatever_the_noise(noise_m):
    found = compared(seen(flat(), ROUND, 0, noise_m), seen(flat(), BACK, 1, noise_m), HERE)
    assert 0.7 < found.support / found.expected < 2.0
    assert found.contradicting_m == 0.0
    assert found.compared_m > 20.0


@pytest.mark.parametrize("off_m", [0.04, 0.08])
def test_walls_some_centimetres_off_are_those_of_another_place(off_m):
    """A room whose walls are farther apart: no alignment removes the offsets."""
    wider = box(0, 0, 9 + 2 * off_m, 8 + 2 * off_m)
    one, other = seen(box(0, 0, 9, 8), ROUND, 0), seen(wider, ROUND, 1)
    found = compared(one, other, np.array([-off_m, -off_m, 0.0]))
    assert found.support < 0.3 * found.expected
    same = compared(one, seen(box(0, 0, 9, 8), BACK, 1), HERE)
    assert same.support > 0.7 * same.expected


def test_furniture_elsewhere_contradicts_and_its_length_is_said():
    assert compared(seen(flat(), ROUND, 0), seen(lookalike(), BACK, 1), HERE).contradicting_m > 2.0


@pytest.mark.parametrize(("length_m", "expected_m"), [(0.5 * WALL_M, 0.0), (2.0, 4.0)])
def test_only_long_walls_in_free_space_contradict(length_m, expected_m):
    """A board of two sides in the middle of a room; a short one may be a person."""
    room = box(0, 0, 9, 8)
    board = np.vstack((room, path((4.0, 4.0), (4.0 + length_m, 4.0)), path((4.0 + length_m, 4.02), (4.0, 4.02))))
    found = compared(seen(room, ROUND, 0), seen(board, [(1, 1), (8, 1), (8, 7), (1, 7), (1, 2)], 1), HERE)
    assert found.contradicting_m == pytest.approx(expected_m, abs=1.0)


def test_the_edge_of_what_a_robot_saw_contradicts_nothing():
    """A robot at the corner of a crossing clears the floor along a wall that it cannot see."""
    crossing = np.vstack(
        (
            path((-12, 1), (-12, -1), (1.6, -1), (1.6, -6.5), (4.1, -6.5), (4.1, -1), (12, -1)),
            path((12, -1), (12, 1), (4.1, 1), (4.1, 14), (1.6, 14), (1.6, 1), (-12, 1)),
        )
    )
    along, across = seen(crossing, [(-8, 0.3), (1.7, 0.3)], 0), seen(crossing, [(2.8, -5), (2.8, 12)], 1)
    assert compared(along, across, HERE).contradicting_m == 0.0


def test_the_order_of_the_maps_does_not_matter():
    one, other = seen(flat(), ROUND, 0), seen(flat(), BACK, 1)
    T = np.array([0.03, -0.02, 0.01])
    there, back = compared(one, other, T), compared(other, one, se2.inverse(T))
    assert np.allclose(there, back, rtol=0.05, atol=1.0)


def test_maps_that_have_nothing_in_common_say_nothing():
    found = compared(seen(flat(), ROUND, 0), seen(flat(), BACK, 1), np.array([50.0, 0.0, 0.0]))
    assert found == total([])


def test_a_map_knows_its_noise():
    quiet, loud = (noise_of([seen(flat(), ROUND, 0, noise_m)]).offset_m for noise_m in (0.002, 0.04))
    assert quiet < NOISE_M < loud
