"""The labelled distance field against a brute-force nearest neighbour."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from fcslam.lidar.field import CELL_M, EMPTY, MERGE_M, REACH_M, TABLE, TILE, SurfelField, field_of
from tests.lidar.worlds import bare_scan, path, ring, ring_drive, room, scan_at

HALF_DIAGONAL_M = CELL_M * np.sqrt(0.5)
SIDE_M = TABLE * TILE * CELL_M


def excess(field, queries):
    """How much farther the labelled surfel is than the nearest one; NaN where there is no label."""
    labels = field.nearest(queries)
    nearest, _ = cKDTree(field.points).query(queries)
    found = np.linalg.norm(queries - field.points[labels], axis=1)
    return np.where(labels == EMPTY, np.nan, found - nearest), nearest


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_nearest_agrees_with_a_search_tree(seed):
    """Points too far apart to merge: the label is the nearest to the cell's centre, so within a cell of the nearest."""
    rng = np.random.default_rng(seed)
    points = np.unique(np.floor(rng.uniform(-30, 30, (60, 2))), axis=0) * 0.12 + rng.uniform(0, 0.05, 2)
    field = SurfelField(rng.uniform(-1, 1, 2))
    field.insert(bare_scan(points), np.zeros(3))
    np.testing.assert_allclose(field.points, points)
    queries = rng.uniform(-4.5, 4.5, (400, 2))
    rest, nearest = excess(field, queries)
    known = ~np.isnan(rest)
    assert np.all(rest[known] <= 2 * HALF_DIAGONAL_M + 1e-9)
    assert np.all(nearest[~known] > REACH_M - HALF_DIAGONAL_M)
    assert np.all(nearest[known] < REACH_M + HALF_DIAGONAL_M)


def test_surfels_that_moved_stay_nearest_within_a_cell_or_two():
    """Surfels are running means: they move under their labels, by no more than returns join from."""
    rng = np.random.default_rng(3)
    poses = ring_drive()[:120:3]
    field = field_of([(scan_at(pose, ring(), noise_m=0.015, rng=rng), pose) for pose in poses])
    queries = field.points[rng.integers(0, len(field.points), 2000)] + rng.normal(0, 0.1, (2000, 2))
    rest, _ = excess(field, queries)
    assert not np.isnan(rest).any()
    assert np.quantile(rest, 0.99) < 2 * HALF_DIAGONAL_M
    assert rest.max() < 2 * HALF_DIAGONAL_M + 2 * MERGE_M


def test_a_dense_scan_again_and_again_neither_spreads_nor_multiplies():
    scan = scan_at((0.4, 0.3, 0.8), room())
    once, often = field_of([(scan, np.zeros(3))]), field_of([(scan, np.zeros(3))] * 20)
    assert len(often.points) <= 1.02 * len(once.points)
    assert cKDTree(scan.points).query(often.points)[0].max() < MERGE_M


def test_noise_averages_out():
    rng = np.random.default_rng(1)
    wall = path((3, -2), (3, 2))
    field = field_of([(scan_at(np.zeros(3), wall, noise_m=0.02, rng=rng), np.zeros(3)) for _ in range(30)])
    counts = field.arrays.surfels[: len(field.points), 4]
    settled = field.points[counts >= 20]
    assert len(settled) > 20
    assert np.sqrt(np.mean((settled[:, 0] - 3) ** 2)) < 0.01


@pytest.mark.parametrize("thickness_m", [0.04, 0.10, 0.20])
def test_both_sides_of_a_wall_stay_apart(thickness_m):
    rng = np.random.default_rng(2)
    wall = np.vstack((path((0, -3), (0, 3)), path((thickness_m, -3), (thickness_m, 3))))
    poses = [np.array([x, y, 0.0]) for x in (-2.0, 2.0) for y in (-1.0, 0.0, 1.0)]
    field = field_of([(scan_at(pose, wall, noise_m=0.01, rng=rng), pose) for pose in poses])
    left = field.normals[:, 0] < -0.5
    right = field.normals[:, 0] > 0.5
    assert left.sum() > 50
    assert right.sum() > 50
    assert np.abs(np.median(field.points[left, 0])) < 0.01
    assert np.abs(np.median(field.points[right, 0]) - thickness_m) < 0.01


@pytest.mark.parametrize("far", [(SIDE_M, 0.0), (-SIDE_M, SIDE_M), (0.0, 1e7), (0.5 * SIDE_M - 0.2, 0.0)])
def test_what_lies_outside_the_table_is_ignored(far):
    field = SurfelField(np.zeros(2))
    field.insert(bare_scan([(1.0, 1.0)]), np.zeros(3))
    before = field.points.copy()
    for _ in range(3):
        field.insert(bare_scan(np.zeros((5, 2))), np.array([*far, 0.0]))
    np.testing.assert_array_equal(field.points, before)
    assert field.nearest(np.array([far])) == [EMPTY]
    assert field.nearest(np.array([(1.0, 1.0)])) == [0]


def test_growth_of_storage_changes_nothing():
    poses = ring_drive()[::25]
    scans = [(scan_at(pose, ring(), noise_m=0.01, rng=np.random.default_rng(k)), pose) for k, pose in enumerate(poses)]
    grown, large = SurfelField(poses[0]), SurfelField(poses[0])
    roomy = {"labels": np.full((4000, TILE, TILE), EMPTY, np.int16), "surfels": np.zeros((50_000, 7))}
    large.arrays = large.arrays._replace(**roomy)
    for scan, pose in scans:
        grown.insert(scan, pose)
        large.insert(scan, pose)
    tiles, surfels, _ = grown.arrays.used
    assert surfels > 1024
    assert tiles > 64
    np.testing.assert_array_equal(grown.arrays.used, large.arrays.used)
    np.testing.assert_array_equal(grown.arrays.surfels[:surfels], large.arrays.surfels[:surfels])
    np.testing.assert_array_equal(grown.arrays.labels[:tiles], large.arrays.labels[:tiles])
    np.testing.assert_array_equal(grown.arrays.table, large.arrays.table)


def test_a_compact_field_is_the_same_field():
    field, kept = (field_of([(scan_at(np.zeros(3), room()), np.zeros(3))]) for _ in range(2))
    kept.compact()
    queries = np.random.default_rng(0).uniform(-30, 30, (2000, 2))
    np.testing.assert_array_equal(kept.nearest(queries), field.nearest(queries))
    np.testing.assert_array_equal(kept.points, field.points)
    assert sum(array.nbytes for array in kept.arrays) < 0.5 * sum(array.nbytes for array in field.arrays)
    empty = field_of([])
    empty.compact()
    assert (empty.nearest(queries) == EMPTY).all()
