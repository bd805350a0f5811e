"""Occupancy grids against the true one: laws, brute force, counts by hand."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.metrics.grid import LabelledGrid, grid_agreement

ORIGIN = np.array([1.0, -2.0, 0.0])
HERE = np.zeros(3)


def room(height=60, width=90, resolution_m=0.05):
    """A room with a niche, unknown outside; no symmetry."""
    occupied = np.zeros((height, width), dtype=np.bool_)
    occupied[5:-5, 5] = occupied[5:-5, -6] = occupied[5, 5:-5] = occupied[-6, 5:-5] = True
    occupied[5:20, 30] = True
    free = np.zeros_like(occupied)
    free[6:-6, 6:-6] = True
    return LabelledGrid(occupied, free & ~occupied, resolution_m, ORIGIN)


def changed(grid, occupied=None, free=None):
    return LabelledGrid(
        grid.occupied if occupied is None else occupied,
        grid.free if free is None else free,
        grid.resolution_m,
        grid.T_frame_grid,
    )


def brute_force(points, others, tolerance_m):
    return np.mean([np.min(np.hypot(*(others - point).T)) <= tolerance_m + 1e-6 for point in points])


def figures(agreement):
    return agreement.precision, agreement.recall, agreement.f1, agreement.free_iou


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (12.3, -4.56, 0.0), (3.0, 8.0, 2.0)])
def test_what_is_the_truth_agrees_wherever_its_frame_lies(frame):
    truth = room()
    grid = LabelledGrid(truth.occupied, truth.free, truth.resolution_m, se2.compose(se2.inverse(frame), ORIGIN))
    assert figures(grid_agreement(grid, truth, np.array(frame))) == pytest.approx((1.0, 1.0, 1.0, 1.0))


@pytest.mark.parametrize("frame", [(0.06, 0.02, 0.0), (0.1, 0.3, 0.1), (-0.2, 0.1, -0.05), (0.1, 0.0, 0.0)])
def test_shares_of_surfaces_are_those_of_brute_force(frame):
    truth, rng = room(), np.random.default_rng(1)
    grid = changed(truth, occupied=truth.occupied & (rng.random(truth.occupied.shape) < 0.7))
    found = grid_agreement(grid, truth, np.array(frame))
    surfaces = se2.transform(frame, grid.centres(grid.occupied))
    walls = truth.centres(truth.occupied)
    assert found.precision == brute_force(surfaces, walls, 0.1)
    assert found.recall == brute_force(walls, surfaces, 0.1)
    assert found.precision < 1.0 or found.recall < 1.0 or frame[0] == 0.06


def test_a_mirrored_map_fails():
    truth = room()
    mirrored = LabelledGrid(truth.occupied[:, ::-1], truth.free[:, ::-1], truth.resolution_m, ORIGIN)
    assert grid_agreement(mirrored, truth, HERE).f1 < 0.98
    assert grid_agreement(mirrored, truth, np.array((0.5, 0.0, 0.0))).f1 < 0.7


def test_surfaces_where_the_truth_knows_nothing_are_wrong():
    truth = room()
    invented = truth.occupied.copy()
    invented[0, :] = True
    found = grid_agreement(changed(truth, occupied=invented), truth, HERE)
    assert found.recall == 1.0
    assert found.precision == pytest.approx(truth.occupied.sum() / invented.sum())


def test_a_surface_within_10_cm_is_right_and_one_further_is_not():
    truth = room()
    for cells, f1 in ((2, 1.0), (3, 0.0)):
        line = np.zeros_like(truth.occupied)
        line[30, 40:50] = True
        moved = np.roll(line, cells, axis=0)
        assert grid_agreement(changed(truth, occupied=moved), changed(truth, occupied=line), HERE).f1 == f1


def test_free_space_is_counted_by_hand():
    truth = room()
    half = truth.free.copy()
    half[:, :40] = False
    fewer = grid_agreement(changed(truth, free=half), truth, HERE).free_iou
    assert fewer == pytest.approx(half.sum() / truth.free.sum())
    assert grid_agreement(truth, changed(truth, free=half), HERE).free_iou == pytest.approx(fewer)
    beyond = truth.free.copy()
    beyond[:5, :] = True
    assert grid_agreement(changed(truth, free=beyond), truth, HERE).free_iou == pytest.approx(
        truth.free.sum() / beyond.sum()
    )


def test_a_coarser_map_covers_the_same_area():
    truth = room(60, 80)
    free = np.kron(truth.free[::2, ::2], np.ones((2, 2))).astype(bool)
    coarse = LabelledGrid(truth.occupied[::2, ::2], truth.free[::2, ::2], 0.1, ORIGIN)
    assert grid_agreement(coarse, changed(truth, free=free), HERE).free_iou == pytest.approx(1.0)


def test_what_cannot_be_compared_is_nan_and_an_empty_map_agrees_with_nothing():
    truth = room()
    nothing = np.zeros_like(truth.free)
    assert np.isnan(figures(grid_agreement(truth, truth, np.full(3, np.nan)))).all()
    empty = grid_agreement(changed(truth, nothing, nothing), truth, HERE)
    assert (empty.recall, empty.f1, empty.free_iou) == (0.0, 0.0, 0.0)
    assert np.isnan(empty.precision)
