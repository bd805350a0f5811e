"""Steps that no robot can make."""

import numpy as np
import pytest

from fcslam.metrics.jumps import find_jumps

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
