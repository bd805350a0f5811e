"""Maps that fit each other in one way only, and maps that do not."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.submap import build_submap
from fcslam.lidar.uniqueness import align_map, alignments
from tests.flats import BACK, ROUND, doors, flat, lookalike, mirrored
from tests.lidar.worlds import box, drive, scan_at

pytestmark = pytest.mark.slow


def map_of(segments, waypoints, seed, T_map_start=(0.0, 0.0, 0.0)):
    """A map, which the robot begins at a pose, and the pose of its frame in the drawing."""
    poses, rng = drive(waypoints, step_m=0.4, step_rad=0.5), np.random.default_rng(seed)
    frame = se2.compose(poses[0], se2.inverse(np.array(T_map_start)))
    scans = [(scan_at(pose, segments, noise_m=0.015, rng=rng), se2.between(frame, pose)) for pose in poses]
    return build_submap(scans, radius_m=60.0), frame


def compared(one, other):
    """The alignment at the true transform of two maps, and the best elsewhere."""
    (a, anchor_a), (b, anchor_b) = one, other
    best = align_map(a, b, se2.between(anchor_a, anchor_b))
    return best, alignments(a, b, best.T_a_b)[0], se2.between(anchor_a, anchor_b)


def test_a_flat_fits_itself_in_one_way_only():
    best, rival, truth = compared(map_of(flat(), ROUND, 0), map_of(flat(), BACK, 1))
    assert np.allclose(se2.between(truth, best.T_a_b), 0.0, atol=0.02)
    assert best.score_m > 3.0 * rival.score_m
    assert best.score_m > 20.0
    assert best.violation < 0.01


@pytest.mark.parametrize("turn_rad", [0.0, 0.8, 1.6, 2.4, 3.2, 4.0, 4.8, 5.6])
def test_the_search_finds_the_true_transform(turn_rad):
    (a, anchor_a), (b, anchor_b) = map_of(flat(), ROUND, 0), map_of(flat(), BACK, 1, (7.0, -4.0, turn_rad))
    found = alignments(a, b)[0]
    assert np.allclose(se2.between(se2.between(anchor_a, anchor_b), found.T_a_b), 0.0, atol=0.05)


def test_other_furniture_stands_in_free_space():
    best, _, _ = compared(map_of(flat(), ROUND, 0), map_of(lookalike(), BACK, 1))
    assert best.score_m > 15.0, "the walls agree"
    assert best.violation > 0.05


def test_a_mirrored_flat_fits_nowhere():
    (a, _), (b, _) = map_of(flat(), ROUND, 0), map_of(mirrored(), [(9.0 - x, y) for x, y in BACK], 1)
    best = alignments(a, b)[0]
    assert best.violation > 0.05


@pytest.mark.parametrize("shift_m", [0.0, 2.5])
def test_a_corridor_of_equal_doors_fits_one_door_farther_as_well(shift_m):
    one = map_of(doors(), [(10.0, 0.0), (22.0, 0.1)], 0)
    other, anchor = map_of(doors(), [(24.0, 0.2), (12.0, 0.0)], 1)
    best, rival, _ = compared(one, (other, se2.compose(np.array([shift_m, 0.0, 0.0]), anchor)))
    assert best.score_m < 1.5 * rival.score_m
    doors_apart = abs(se2.between(best.T_a_b, rival.T_a_b)[0]) / 2.5
    assert doors_apart == pytest.approx(max(1, round(doors_apart)), abs=0.1)


def test_an_empty_map_fits_nothing():
    empty, _ = map_of(box(900, 900, 901, 901), [(0.0, 0.0), (1.0, 0.0)], 0)
    assert not alignments(empty, map_of(flat(), ROUND, 0)[0])
