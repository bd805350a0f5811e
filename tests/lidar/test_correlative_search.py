"""Branch and bound against exhaustive search over the same window."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.geometry import se2
from fcslam.lidar.correlative import CELL_M, SearchWindow, likelihood_pyramid, search, search_pyramid
from fcslam.lidar.field import field_of
from tests.lidar.worlds import bare_scan, room, scan_at


def random_scan(rng, count, reach):
    points = rng.uniform(-reach, reach, (count, 2))
    return bare_scan(points)


def steps(scan, window, cell_m):
    """Angle of one turn that moves far points by a cell, and the numbers of turns and shifts to either side."""
    reach = max(1.0, np.quantile(np.hypot(*scan.points.T), 0.9))
    step_rad = 2 * np.arcsin(min(0.5, 0.5 * cell_m / reach))
    return step_rad, int(np.ceil(window.angle_rad / step_rad)), int(np.ceil(window.radius_m / cell_m))


def exhaustive(scan, pyramid, guess, window):
    """Best penalised score over every shift and turn of the window."""
    grid, cell = pyramid.levels[0].astype(float), pyramid.cell_m
    step, turns, shifts = steps(scan, window, cell)
    moves = np.arange(-shifts, shifts + 1)
    best = -1.0
    for turn in range(-turns, turns + 1):
        points = se2.transform(guess + np.array([0, 0, turn * step]), scan.points)
        cells = np.floor((points - pyramid.corner) / cell).astype(int)
        raw = np.zeros((len(moves), len(moves)))
        for x, y in cells:
            rows, columns = y + moves, x + moves
            inside = ((rows >= 0) & (rows < len(grid)))[:, None] & ((columns >= 0) & (columns < len(grid)))[None]
            raw += np.where(inside, grid[np.ix_(rows.clip(0, len(grid) - 1), columns.clip(0, len(grid) - 1))], 0.0)
        away = window.distance_penalty * np.minimum(1, (moves[:, None] ** 2 + moves**2) / max(1, shifts**2))
        penalty = (1 - away) * (1 - window.angle_penalty * (turn / max(1, turns)) ** 2)
        best = max(best, float((raw / (255 * len(points)) * penalty).max()))
    return best


def penalised(result, guess, window, scan):
    """The score of a result with the penalty of where it lies."""
    pose, score = result
    step, turns, shifts = steps(scan, window, CELL_M)
    move = np.round((pose[:2] - guess[:2]) / CELL_M)
    turn = np.round(se2.wrap_angle(pose[2] - guess[2]) / step)
    away = window.distance_penalty * min(1, float(move @ move) / max(1, shifts**2))
    return score * (1 - away) * (1 - window.angle_penalty * (turn / max(1, turns)) ** 2)


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**32 - 1),
    radius=st.sampled_from([0.0, 0.3, 0.75, 1.2]),
    angle=st.sampled_from([0.0, 0.2]),
    levels=st.integers(1, 6),
    half_side=st.sampled_from([2.0, 6.0]),
)
@settings(max_examples=60)
def test_the_best_score_is_that_of_exhaustive_search(seed, radius, angle, levels, half_side):
    """On random worlds; with the small grid, points leave it on every side."""
    rng = np.random.default_rng(seed)
    field = field_of([(random_scan(rng, 40, 3.0), np.zeros(3))])
    scan, guess = random_scan(rng, 25, 3.0), rng.uniform(-1, 1, 3)
    window = SearchWindow(radius, angle, 0.2, 0.1)
    pyramid = likelihood_pyramid(field, guess, half_side, levels=levels)
    found = search_pyramid(scan, pyramid, guess, window)
    best = exhaustive(scan, pyramid, guess, window)
    assert penalised(found, guess, window, scan) == pytest.approx(best, abs=1e-9)


@pytest.mark.parametrize("offset", [(8.0, 0.0, np.deg2rad(40)), (-5.0, 6.0, np.deg2rad(-35)), (1.0, -8.0, 0.0)])
def test_a_far_offset_is_recovered_in_a_wide_window(offset):
    walls = room()
    rng = np.random.default_rng(1)
    poses = [np.array([x, y, 0.3]) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 1.0)]
    field = field_of([(scan_at(pose, walls, noise_m=0.015, rng=rng), pose) for pose in poses])
    truth = np.array([0.4, 0.2, 0.1])
    scan = scan_at(truth, walls, noise_m=0.015, rng=rng)
    found, _ = search(scan, field, truth + np.array(offset), SearchWindow(8.5, 0.75))
    rest = se2.between(truth, found)
    assert np.hypot(rest[0], rest[1]) < 0.15
    assert abs(rest[2]) < np.deg2rad(2)


def test_nothing_to_see_answers_with_the_guess():
    guess = np.array([1.0, -2.0, 0.5])
    nothing = bare_scan([])
    field = field_of([(scan_at((0, 0, 0), room()), np.zeros(3))])
    far = np.array([150.0, 0.0, 0.5])
    for scan, where, there in (
        (nothing, field, guess),
        (scan_at((0, 0, 0), room()), field_of([]), guess),
        (nothing, field, far),
    ):
        found, score = search(scan, where, there, SearchWindow(1.0, 0.3))
        np.testing.assert_array_equal(found, there)
        assert score == 0.0
