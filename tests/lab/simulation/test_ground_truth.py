"""The truth of a fleet: relations between its scans, and the map of what its beams met."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from fcslam.lab.simulation.floorplan import PieceKind
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.recording import true_map, write_ground_truth
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.maps.occupancy_map import Occupancy
from tests.lab.simulation.driving import distances

pytestmark = pytest.mark.slow

SETTINGS = SimulationSettings(
    building=Building.FLAT, robots=2, path_length_m=30.0, camera=None, lidar=LidarSettings(max_range_m=6.0, rate_hz=5.0)
)


@pytest.fixture(scope="module")
def fleet():
    return simulate_fleet(SETTINGS, 1)


@pytest.fixture(scope="module")
def seen(fleet):
    return true_map(fleet)


def centres(seen, occupancy):
    rows, columns = np.nonzero(seen.cells == occupancy)
    return (np.column_stack((columns, rows)) + 0.5) * seen.resolution_m + seen.origin_xy


def is_inside(points, outline):
    along = np.roll(outline, -1, axis=0) - outline
    offsets = points[:, None] - outline
    return np.all(along[:, 0] * offsets[..., 1] - along[:, 1] * offsets[..., 0] > 0.0, axis=1)


def test_occupied_cells_are_surfaces_and_free_ones_are_not_inside_anything(fleet, seen):
    half_diagonal = seen.resolution_m * np.sqrt(0.5)
    occupied, free = centres(seen, Occupancy.OCCUPIED), centres(seen, Occupancy.FREE)
    # Columns are round for beams, and have eight corners in the plan.
    assert distances(occupied, fleet.plan.segments).max() < half_diagonal + 0.03
    deep = distances(free, fleet.plan.segments) > seen.resolution_m
    solid = [piece.outline for piece in fleet.plan.pieces if piece.kind is not PieceKind.LINTEL]
    assert not np.any([is_inside(free[deep], outline) for outline in solid])


def test_where_robots_drove_is_free(fleet, seen):
    for robot in fleet.robots:
        cells = np.floor((robot.T_building_base[:, :2] - seen.origin_xy) / seen.resolution_m).astype(int)
        assert np.all(seen.cells[cells[:, 1], cells[:, 0]] == Occupancy.FREE)


def test_what_no_robot_saw_is_unknown(fleet, seen):
    one = true_map(replace(fleet, robots=fleet.robots[:1]))
    known, more = one.cells != Occupancy.UNKNOWN, seen.cells != Occupancy.UNKNOWN
    assert np.all(more[known])
    assert 0.2 < known.mean() < more.mean() < 1.0
    far = np.linalg.norm(
        centres(one, Occupancy.OCCUPIED)[:, None] - fleet.robots[0].T_building_base[::5, :2], axis=2
    ).min(axis=1)
    assert far.max() < 6.0 + 0.1


def test_noise_does_not_reach_the_truth(fleet, seen):
    noisy = SETTINGS.model_copy(update={"lidar": SETTINGS.lidar.model_copy(update={"range_noise_m": 0.5})})
    np.testing.assert_array_equal(true_map(simulate_fleet(noisy, 1)).cells, seen.cells)


def test_the_files_hold_the_map(fleet, seen, tmp_path):
    write_ground_truth(fleet, tmp_path)
    assert sorted(path.name for path in (tmp_path / "ground_truth").iterdir()) == ["map.pgm", "map.yaml"]
    about = yaml.safe_load((tmp_path / "ground_truth" / "map.yaml").read_text())
    assert about["resolution"] == 0.05
    assert tuple(about["origin"][:2]) == seen.origin_xy
    pixels = cv2.imread(str(tmp_path / "ground_truth" / about["image"]), cv2.IMREAD_GRAYSCALE)[::-1]
    np.testing.assert_array_equal(pixels == 0, seen.cells == Occupancy.OCCUPIED)
    np.testing.assert_array_equal(pixels == 254, seen.cells == Occupancy.FREE)
