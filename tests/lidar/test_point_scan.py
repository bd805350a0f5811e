"""Points and normals of one scan, against the walls that were drawn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.geometry import se2
from fcslam.lidar.scan import point_scan
from fcslam.records import LaserModel, frozen
from tests.lidar.worlds import LASER, MAX_RANGE_M, bare_scan, path, room, scan_at


def clear_of_ends(points, segments, margin_m):
    """Wall of each point (index, distance), and whether the point is farther than the margin from its ends."""
    start, side = segments[:, :2], segments[:, 2:] - segments[:, :2]
    length = np.hypot(*side.T)
    along = np.einsum("nsk,sk->ns", points[:, None] - start, side / length[:, None])
    inside = np.clip(along, 0, length)
    foot = start + inside[..., None] * (side / length[:, None])
    distance = np.linalg.norm(points[:, None] - foot, axis=2)
    wall = distance.argmin(axis=1)
    rows = np.arange(len(points))
    clear = (along[rows, wall] > margin_m) & (along[rows, wall] < length[wall] - margin_m)
    return wall, distance[rows, wall], clear


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (-2.0, 1.0, 2.5), (1.2, -1.9, -0.7)])
def test_points_lie_on_the_walls_and_normals_stand_on_them_facing_the_laser(pose):
    walls = room()
    scan = scan_at(pose, walls)
    points = se2.transform(pose, scan.points)
    wall, distance, clear = clear_of_ends(points, walls, 0.5)
    assert distance.max() < 1e-5
    normals = se2.transform((0, 0, pose[2]), scan.normals)
    known = clear & (np.hypot(*normals.T) > 0)
    assert known[clear].mean() > 0.95
    np.testing.assert_allclose(np.hypot(*normals[known].T), 1.0, atol=1e-9)
    along = walls[wall, 2:] - walls[wall, :2]
    along /= np.hypot(*along.T)[:, None]
    tilt = np.rad2deg(np.arcsin(np.abs(np.einsum("nk,nk->n", normals, along)[known])))
    assert tilt.max() < 2.0
    assert np.all(np.einsum("nk,nk->n", normals, np.array(pose[:2]) - points)[known] > 0)


INVALID = [np.nan, np.inf, -np.inf, 0.0, -1.0, MAX_RANGE_M, MAX_RANGE_M + 5.0]


@given(st.lists(st.sampled_from([*INVALID, 0.5, 3.0, 19.9]), min_size=1, max_size=40))
@settings(max_examples=100)
def test_only_returns_become_points(found):
    laser = LaserModel(len(found), -1.0, 0.05, MAX_RANGE_M)
    scan = point_scan(frozen(found, np.float32), laser)
    valid = np.array([k for k, r in enumerate(found) if r in (0.5, 3.0, 19.9)], dtype=int)
    r, angle = np.array(found, np.float32)[valid].astype(float), laser.angles_rad()[valid]
    np.testing.assert_allclose(scan.points, np.column_stack((r * np.cos(angle), r * np.sin(angle))), atol=1e-9)
    assert len(scan) == len(valid) == len(scan.normals)
    assert np.isfinite(scan.normals).all()


def test_a_normal_does_not_bridge_a_gap():
    """A post in front of a wall: the wall behind it keeps its own normals."""
    walls = np.vstack((path((4, -5), (4, 5)), path((2, -0.2), (2, 0.2))))
    scan = scan_at((0, 0, 0), walls)
    known = np.hypot(*scan.normals.T) > 0
    np.testing.assert_allclose(scan.normals[known], np.tile((-1.0, 0.0), (known.sum(), 1)), atol=1e-3)
    assert known.sum() > 0.9 * len(scan)


def test_thinned_keeps_distance_and_limit():
    scan = scan_at((0, 0, 0), room())
    thinned = scan.thinned(0.2, 1000)
    apart_m = np.hypot(*np.diff(thinned.points, axis=0).T)
    assert np.mean(apart_m >= 0.2) > 0.9
    assert apart_m.min() > 0.1
    assert len(scan.thinned(0.0, 50)) == 50
    assert len(bare_scan([]).thinned(0.1, 5)) == 0


@pytest.mark.parametrize("spacing_m", [0.03, 0.05, 0.1])
def test_noise_does_not_decide_which_returns_are_kept(spacing_m):
    """On a wall, an error of a range moves a return along the wall as well. Were returns kept by their own distance,
    those on one side of the foot of the perpendicular would be too far, those on the other side too near: the wall
    would seem turned.
    """
    rng = np.random.default_rng(1)
    walls = path((2, -6), (2, 6))
    turns = []
    for _ in range(300):
        points = scan_at((0, 0, 0), walls, noise_m=0.015, rng=rng).thinned(spacing_m).points
        x, y = points[np.abs(points[:, 1]) < 3.0].T
        turns.append(np.polyfit(y, x, 1)[0])
    assert abs(np.mean(turns)) < 4.0 * np.std(turns) / np.sqrt(len(turns))


def test_ranges_of_another_laser_are_refused():
    with pytest.raises(ValueError, match="360"):
        point_scan(np.full(400, 3.0, np.float32), LASER)
