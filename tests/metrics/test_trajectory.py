"""Trajectories against the truth: laws, and the alignment against a singular value decomposition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable
from fcslam.metrics.trajectory import (
    PositionErrors,
    align,
    find_jumps,
    interpolate,
    near_pairs,
    placement_error,
    position_errors,
    relative_errors,
)

STEPS = 200
frames = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))


def walk(seed, start=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(seed)
    poses = [np.array(start)]
    for turn in rng.normal(0.0, 0.2, STEPS - 1):
        poses.append(se2.compose(poses[-1], (0.1, 0.0, turn)))
    return np.array(poses)


def noisy(poses, seed=5):
    return se2.compose(poses, np.random.default_rng(seed).normal(0.0, (0.1, 0.1, 0.05), poses.shape))


def fleet(moved=(0.0, 0.0, 0.0), maps=(0, 0)):
    """Truth and estimate of two robots that start together; the second one's estimate is moved."""
    true = np.concatenate([walk(1), walk(2)])
    robots = np.repeat([0, 1], STEPS)
    estimate = np.where((robots == 1)[:, None], se2.compose(moved, true), true)
    stamps = np.tile(np.arange(STEPS), 2) + 0.5 * robots
    return PoseTable.of(stamps, true, robots), PoseTable.of(stamps, estimate, robots, np.take(maps, robots))


def rmse(truth, estimate, T_truth_map):
    return PositionErrors.of(position_errors(T_truth_map, truth, estimate)).rmse_m


def umeyama(a, b):
    """Rotation and shift that take the points b onto a, by singular value decomposition."""
    U, _, Vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = U @ np.diag([1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R, a.mean(0) - R @ b.mean(0)


def test_the_alignment_is_that_of_a_singular_value_decomposition():
    true = walk(3)
    estimate = noisy(se2.compose((3.0, -2.0, 2.5), true))
    R, shift = umeyama(true[:, :2], estimate[:, :2])
    expected = np.linalg.norm(estimate[:, :2] @ R.T + shift - true[:, :2], axis=1)
    assert np.allclose(position_errors(align(true, estimate), true, estimate), expected, atol=1e-12)


@given(frames, frames)
def test_ate_does_not_depend_on_where_map_and_truth_have_their_origin(a, b):
    true = walk(3)
    estimate = noisy(true)
    expected = rmse(true, estimate, align(true, estimate))
    moved_true, moved = se2.compose(a, true), se2.compose(b, estimate)
    assert rmse(moved_true, moved, align(moved_true, moved)) == pytest.approx(expected, abs=1e-9)
    assert expected == pytest.approx(0.1 * np.sqrt(2.0), rel=0.1)


def test_what_is_the_truth_has_no_error_and_what_is_mirrored_has():
    true = walk(4)
    assert rmse(true, true, align(true, true)) < 1e-9
    mirrored = true * (1.0, -1.0, -1.0)
    assert rmse(true, mirrored, align(true, mirrored)) > 0.5


def test_figures_of_position_errors():
    assert PositionErrors.of(np.array([3.0, 4.0, 0.0, 1.0])) == PositionErrors(np.sqrt(6.5), 2.0, 4.0)
    assert np.isnan(PositionErrors.of(np.array([])).rmse_m)
    still = np.zeros((5, 3))
    assert np.isnan(align(still, still)).all(), "positions of who stands still determine no rotation"


def test_a_robot_moved_by_a_metre_shows_across_robots_and_not_within():
    truth, estimate = fleet(moved=(1.0, 0.0, 0.0))
    rng = np.random.default_rng(0)
    within = relative_errors(near_pairs(truth, rng, across_robots=False), truth, estimate)
    across = relative_errors(near_pairs(truth, rng, across_robots=True), truth, estimate)
    assert within.used == across.used == 2000
    assert within.translation.maximum < 1e-9
    assert across.translation_m == pytest.approx(np.ones(2000))
    assert across.rotation.maximum < 1e-6
    joint = align(truth.T_map_base, estimate.T_map_base)
    rows = truth.robots == 1
    alone = align(truth.T_map_base[rows], estimate.T_map_base[rows])
    assert rmse(truth.T_map_base[rows], estimate.T_map_base[rows], joint) > 0.3
    assert rmse(truth.T_map_base[rows], estimate.T_map_base[rows], alone) < 1e-9


def test_pairs_are_near_in_truth_and_those_of_two_maps_are_counted_as_not_usable():
    truth, estimate = fleet(maps=(0, 1))
    pairs = near_pairs(truth, np.random.default_rng(0), across_robots=True, count=300, reach_m=2.0)
    i, j = pairs.T
    assert np.hypot(*(truth.T_map_base[i] - truth.T_map_base[j])[:, :2].T).max() < 2.0
    assert np.all(truth.robots[i] != truth.robots[j])
    errors = relative_errors(pairs, truth, estimate)
    assert (errors.used, errors.total) == (0, len(pairs))
    assert len(near_pairs(PoseTable.of([], np.empty((0, 3))), np.random.default_rng(0), across_robots=True)) == 0


def test_placement_is_what_one_robot_would_have_to_be_moved():
    def error(moved, b=None):
        a, b = walk(1), walk(2) if b is None else b
        frame = (7.0, -4.0, 1.2)
        estimates = se2.compose(frame, a), se2.compose(frame, se2.compose(moved, b))
        return placement_error((a, estimates[0]), (b, estimates[1]))

    assert error((0.0, 0.0, 0.0)) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert error((0.6, 0.8, 0.0)) == pytest.approx((1.0, 0.0), abs=1e-6)
    assert error((0.0, 0.0, np.radians(20.0)))[1] == pytest.approx(20.0)
    still = np.tile((2.0, 1.0, 0.5), (STEPS, 1))
    assert error((0.6, 0.8, 0.0), still) == pytest.approx((1.0, 0.0), abs=1e-6)


def test_between_stamps_poses_are_interpolated_the_short_way_round():
    stamps = np.array([1.0, 0.0, 3.0])
    poses = np.array([(2.0, 0.0, -3.0), (0.0, 4.0, 3.0), (2.0, 0.0, 0.0)])
    found = interpolate(stamps, poses, np.array([0.0, 0.5, 1.0, 2.0, 3.0, -0.1, 3.1]), gap_s=1.0)
    assert found[0] == pytest.approx(poses[1])
    assert found[1, :2] == pytest.approx((1.0, 2.0))
    assert abs(found[1, 2]) == pytest.approx(np.pi)
    assert found[2] == pytest.approx(poses[0])
    assert found[4] == pytest.approx(poses[2])
    assert np.isnan(found[[3, 5, 6]]).all(), "in too long a gap, before the first, after the last"
    single = interpolate(stamps[:1], poses[:1], np.array([1.0, 1.1]), gap_s=1.0)
    assert single[0] == pytest.approx(poses[0])
    assert np.isnan(single[1]).all()


STAMPS = 0.1 * np.arange(50)
DRIVE = np.column_stack((0.08 * np.arange(50), np.zeros(50), np.zeros(50)))


def test_a_drive_has_no_jumps():
    assert find_jumps(STAMPS, DRIVE) is None
    assert find_jumps(STAMPS[:1], DRIVE[:1]) is None


@pytest.mark.parametrize(("axis", "size"), [(0, 0.57), (1, -0.6), (2, 1.0)])
def test_a_jump_is_found_with_its_stamp(axis, size):
    poses = DRIVE.copy()
    poses[20:, axis] += size
    poses[40:, axis] += 0.9 * size
    jumps = find_jumps(STAMPS, poses)
    assert jumps is not None
    assert (jumps.count, jumps.stamp) == (2, STAMPS[20])
    assert max(jumps.largest_m, jumps.largest_rad) == pytest.approx(abs(size), abs=0.1)
    assert "2 jumps, the largest of" in str(jumps)


def test_a_gap_excuses_it():
    poses = DRIVE.copy()
    poses[20:, 0] += 0.6
    later = STAMPS + np.where(np.arange(50) >= 20, 2.0, 0.0)
    assert find_jumps(later, poses) is None
    assert "1 jump of" in str(find_jumps(STAMPS, poses))


def test_a_clock_that_steps_back_is_no_time():
    jumps = find_jumps(np.array([1.0, 0.5]), np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)]))
    assert jumps is not None
    assert jumps.within_s == 0.0
