"""Stamps of transforms, and maps of which only the changes are sent."""

import numpy as np
import pytest

from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import frozen
from fcslam.ros.outputs import Grid, Outputs, Region, changed_region
from fcslam.ros.transform_stream import TransformStream
from tests.ros.memory_network import MemoryNetwork

SECOND = 10**9
POSE = np.zeros(3)


def occupancy(cells, origin=(0.0, 0.0)):
    return OccupancyMap(frozen(cells, np.uint8), 0.05, origin)


@pytest.fixture
def network():
    return MemoryNetwork()


@pytest.fixture
def published(network):
    return Outputs(network, "/robot1", "map", "/tf")


def test_a_map_that_stays_the_same_is_sent_once(network, published):
    cells = np.full((4, 5), Occupancy.FREE)
    assert published.map(1, occupancy(cells))
    assert not published.map(2, occupancy(cells))
    assert len(network.sent["/robot1/map"]) == 1


def test_a_small_map_goes_out_whole(network, published):
    cells = np.full((4, 5), Occupancy.FREE)
    published.map(1, occupancy(cells))
    cells = cells.copy()
    cells[1, 2] = Occupancy.OCCUPIED
    published.map(2, occupancy(cells))
    assert network.sent["/robot1/map"][-1].data.reshape(4, 5)[1, 2] == 100
    assert not network.sent["/robot1/map_updates"]


def test_who_takes_no_updates_gets_their_cells_with_the_next_whole_map(network, published):
    """As the static layer of Nav2 by default."""
    cells = np.full((4, 5), Occupancy.FREE)
    published.map(1, occupancy(cells))
    cells = cells.copy()
    cells[1, 2] = Occupancy.OCCUPIED
    assert published.map(2, occupancy(cells), only_changes=True)
    assert not published.map(3, occupancy(cells), only_changes=True)
    assert len(network.sent["/robot1/map"]) == len(network.sent["/robot1/map_updates"]) == 1
    assert published.map(4, occupancy(cells))
    assert not published.map(5, occupancy(cells))
    assert network.sent["/robot1/map"][-1].data.reshape(4, 5)[1, 2] == 100
    assert len(network.sent["/robot1/map_updates"]) == 1


def test_of_a_large_map_what_differs_from_the_last_whole_one_goes_out(network):
    published = Outputs(network, "/robot1", "map", "/tf", small_map_cells=1)
    first = np.full((4, 5), Occupancy.UNKNOWN)
    published.map(1, occupancy(first))
    second = first.copy()
    second[1, 2] = Occupancy.OCCUPIED
    published.map(2, occupancy(second))
    third = second.copy()
    third[3, 3] = Occupancy.FREE
    published.map(3, occupancy(third))
    assert len(network.sent["/robot1/map"]) == 1
    update = network.sent["/robot1/map_updates"][-1]
    assert (update.x, update.y, update.width, update.height) == (2, 1, 2, 3)
    assert update.data.tolist() == [100, -1, -1, -1, -1, 0]
    published.map(4, occupancy(third, origin=(-1.0, 0.0)))
    assert len(network.sent["/robot1/map"]) == 2


def test_a_cell_that_changes_back_is_free_at_every_subscriber(network):
    """A person stands in a large map and walks on, while another part of it changes."""
    published = Outputs(network, "/robot1", "map", "/tf", small_map_cells=1)
    cells = [np.full((6, 8), Occupancy.FREE, np.uint8) for _ in range(3)]
    cells[1][1, 1] = Occupancy.OCCUPIED
    cells[2][4, 6] = Occupancy.OCCUPIED
    for stamp, each in enumerate(cells):
        published.map(stamp, occupancy(each))
    (whole,) = network.sent["/robot1/map"]
    early = whole.data.reshape(6, 8).copy()
    for update in network.sent["/robot1/map_updates"]:
        rows, columns = slice(update.y, update.y + update.height), slice(update.x, update.x + update.width)
        early[rows, columns] = update.data.reshape(update.height, update.width)
    late = whole.data.reshape(6, 8).copy()
    late[rows, columns] = update.data.reshape(update.height, update.width)
    assert np.argwhere(early == 100).tolist() == np.argwhere(late == 100).tolist() == [[4, 6]]


def test_grids_that_cover_other_cells_have_no_region():
    grid = Grid(np.zeros((2, 3), np.int8), 0.05, (0.0, 0.0))
    assert changed_region(grid, grid) == Region(0, 0, 0, 0)
    assert changed_region(grid, grid._replace(origin_xy=(1.0, 0.0))) is None
    assert changed_region(grid, grid._replace(values=np.zeros((3, 2), np.int8))) is None


def test_covariance_is_that_of_x_y_and_yaw(network, published):
    published.pose(5 * SECOND, np.array((1.0, 2.0, np.pi / 2)), np.diag((0.1, 0.2, 0.3)))
    (pose,) = network.sent["/robot1/pose"]
    assert np.diag(pose.pose.covariance.reshape(6, 6)).tolist() == [0.1, 0.2, 0, 0, 0, 0.3]
    assert pose.pose.pose.orientation.z == pytest.approx(np.sin(np.pi / 4))


def test_closures_and_diagnostics(network, published):
    published.closures(1, np.array([[[0.0, 0.0], [1.0, 2.0]]]))
    (markers,) = network.sent["/robot1/closures"]
    assert [(point.x, point.y) for point in markers.markers[0].points] == [(0.0, 0.0), (1.0, 2.0)]
    published.diagnostics(1, "anna", "lost", {"scans": 3})
    (array,) = network.sent["/diagnostics"]
    assert array.status[0].name == "fcslam: anna"
    assert (array.status[0].level, array.status[0].message) == (1, "lost")


def test_the_path_is_thinned(network, published):
    poses = np.column_stack((np.linspace(0.0, 1.0, 101), np.zeros((101, 2))))
    published.path(1, np.arange(101.0), poses)
    (path,) = network.sent["/robot1/path"]
    assert len(path.poses) <= 12
    assert path.poses[-1].pose.position.x == 1.0


def test_a_long_path_has_longer_steps(network, published):
    poses = np.column_stack((np.linspace(0.0, 1000.0, 20_001), np.zeros((20_001, 2))))
    published.path(1, np.arange(20_001.0), poses)
    (path,) = network.sent["/robot1/path"]
    assert 3900 <= len(path.poses) <= 5200


def test_stamps_grow_between_scans_up_to_the_bound():
    stream = TransformStream(bound_ns=SECOND, timeout_ns=SECOND // 5)
    assert stream.due(0) is None
    stream.add(100 * SECOND, 7 * SECOND, POSE)
    ahead = [stream.due(7 * SECOND + step * SECOND // 4) for step in range(8)]
    stamps = [due.stamp_ns / SECOND for due in ahead if due is not None]
    assert stamps == [100.2, 100.45, 100.7, 100.95, 101.2]


def test_stamps_never_go_back_but_after_a_restart():
    stream = TransformStream(bound_ns=SECOND, timeout_ns=0)
    stream.add(100 * SECOND, 0, POSE)
    assert stream.due(SECOND).stamp_ns == 101 * SECOND
    stream.add(100 * SECOND + 1, SECOND, POSE)
    assert stream.due(SECOND) is None
    stream.add(50 * SECOND, 2 * SECOND, POSE)
    assert stream.due(9 * SECOND).stamp_ns > 101 * SECOND
    stream.restart()
    stream.add(50 * SECOND, 10 * SECOND, POSE)
    assert stream.due(10 * SECOND).stamp_ns == 50 * SECOND
