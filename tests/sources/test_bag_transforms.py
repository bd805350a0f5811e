"""The tree of transforms against SciPy's rotations."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fcslam.records import Transform
from fcslam.sources.bags.transforms import TransformTree, mounting, planar, transform_of

lengths = st.floats(-10, 10)
vectors = st.tuples(lengths, lengths, lengths)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


def unit(q):
    return tuple(float(value) for value in np.array(q) / np.linalg.norm(q))


@given(quaternions)
def test_the_matrix_of_a_rotation(quaternion):
    expected = Rotation.from_quat(quaternion).as_matrix()
    matrix = Transform((0.0, 0.0, 0.0), unit(quaternion)).rotation_matrix()
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


@st.composite
def chains(draw):
    """Frames f0, f1 ..., each hanging on an earlier one, with matrices in f0."""
    count = draw(st.integers(2, 6))
    tree, matrices = TransformTree(), [np.eye(4)]
    for k in range(1, count):
        parent = draw(st.integers(0, k - 1))
        at, q = draw(vectors), unit(draw(quaternions))
        tree.add(f"f{parent}", f"f{k}", transform_of(at, q))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(q).as_matrix(), at
        matrices.append(matrices[parent] @ matrix)
    return tree, matrices


@settings(max_examples=100, deadline=None)
@given(chains(), st.data())
def test_any_two_frames_of_a_tree(chain, data):
    tree, matrices = chain
    a, b = (data.draw(st.integers(0, len(matrices) - 1)) for _ in range(2))
    expected = np.linalg.inv(matrices[a]) @ matrices[b]
    found = tree.fixed(f"f{a}", f"f{b}")
    np.testing.assert_allclose(found.translation_m, expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(found.rotation_matrix(), expected[:3, :3], atol=1e-9)


@settings(deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.booleans())
def test_mountings(yaw, tilt, upside_down):
    rotation = Rotation.from_euler("ZY", [yaw, tilt]) * Rotation.from_euler("x", math.pi * upside_down)
    found = mounting(transform_of((1.0, 2.0, 3.0), tuple(rotation.as_quat().tolist())))
    assert found.upside_down is upside_down
    assert found.tilt_rad == pytest.approx(abs(tilt), abs=1e-6)
    assert found.T_base_laser[:2] == (1.0, 2.0)
    assert math.remainder(found.T_base_laser[2] - yaw, math.tau) == pytest.approx(0.0, abs=1e-6)


@settings(deadline=None)
@given(st.floats(-3.14, 3.14))
def test_the_heading_is_that_of_the_x_axis_whatever_the_sign(yaw):
    q = Rotation.from_euler("z", yaw).as_quat()
    for signed in (q, -q):
        assert planar(transform_of((0.0, 0.0, 0.0), tuple(signed.tolist())))[2] == pytest.approx(yaw, abs=1e-9)


@pytest.mark.parametrize(
    ("at", "q"),
    [
        ((math.nan, 0, 0), (0, 0, 0, 1)),
        ((0, math.inf, 0), (0, 0, 0, 1)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (0, 0, 0, math.nan)),
        ((0, 0, 0), (1, 1, 1, 1)),
    ],
)
def test_what_is_no_transform(at, q):
    with pytest.raises(ValueError, match=r"is not a unit quaternion|is not finite"):
        transform_of(at, q)
