"""Quaternions as matrices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fcslam.geometry.rotations import rotation_matrix


@pytest.mark.parametrize("seed", range(5))
def test_the_matrix_is_that_of_scipy(seed):
    quaternion = Rotation.random(rng=np.random.default_rng(seed)).as_quat()
    np.testing.assert_allclose(
        rotation_matrix(tuple(quaternion)), Rotation.from_quat(quaternion).as_matrix(), atol=1e-12
    )


def test_no_turn_is_the_identity():
    np.testing.assert_array_equal(rotation_matrix((0.0, 0.0, 0.0, 1.0)), np.eye(3))
