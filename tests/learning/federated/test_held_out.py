"""How alike two keyframes are, in a hall whose points and poses are known."""

import numpy as np
import pytest

from fcslam.learning.federated.held_out import APART_M, inliers
from tests.learning.test_revisits import view
from tests.lidar.worlds import box


@pytest.mark.parametrize(("apart_m", "is_one_place"), [(1.0, True), (9.0, False)])
def test_views_along_one_hall_are_taken_for_one_place_only_if_they_are_near(apart_m, is_one_place):
    rng = np.random.default_rng(1)
    end = np.column_stack((np.full(400, 8.0), rng.uniform(-2.0, 2.0, 400), rng.uniform(0.1, 1.8, 400)))
    hall, poses = box(-8.0, -2.0, 8.0, 2.0), ((4.0, 0.0, 0.0), (4.0 - apart_m, 0.0, 0.0))
    near, far = (view(pose, hall, end, seed)[0] for seed, pose in enumerate(poses))
    seen = inliers(near, far)
    assert seen > 50
    counted = inliers(near, far, APART_M)
    assert counted == seen if is_one_place else counted < 0.2 * seen
