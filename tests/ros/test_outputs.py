"""Stamps of transforms, and what a robot publishes."""

import numpy as np
import pytest

from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import frozen
from fcslam.ros.clock import TransformStream
from fcslam.ros.outputs import Outputs
from fcslam.wire.fleet_replies import TeammatePose
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


def test_a_map_is_sent_again_if_it_changed(network, published):
    cells = np.full((4, 5), Occupancy.FREE)
    assert published.map(1, occupancy(cells))
    assert not published.map(2, occupancy(cells))
    assert len(network.sent["/robot1/map"]) == 1
    cells = cells.copy()
    cells[1, 2] = Occupancy.OCCUPIED
    assert published.map(2, occupancy(cells))
    assert network.sent["/robot1/map"][-1].data.reshape(4, 5)[1, 2] == 100
    assert published.map(3, occupancy(cells, origin=(-1.0, 0.0)))


def test_closures_and_diagnostics(network, published):
    published.closures(1, np.array([[[0.0, 0.0], [1.0, 2.0]]]))
    (markers,) = network.sent["/robot1/closures"]
    assert [(point.x, point.y) for point in markers.markers[0].points] == [(0.0, 0.0), (1.0, 2.0)]
    published.diagnostics(1, "anna", "lost", {"scans": 3}, "mapping")
    (array,) = network.sent["/diagnostics"]
    assert array.status[0].name == "fcslam: anna"
    assert (array.status[0].level, array.status[0].message) == (1, "lost")


def test_two_robots_never_share_a_topic(network, published):
    mates = [
        TeammatePose(robot=name, map=0, floor="", pose=(x, 0.0, 0.0), age_s=0.0, stamp=0.0)
        for name, x in (("r-2", 1.0), ("r_2", 2.0))
    ]
    for turn in (mates, mates[::-1], mates[1:]):
        published.fleet(1, turn, 0)
    assert [pose.pose.position.x for pose in network.sent["/robot1/fleet/r_2/pose"]] == [1.0, 1.0]
    said = {status.name: (status.level, status.message) for status in network.sent["/robot1/fleet/status"][0].status}
    assert said["robot r-2"] == (0, "map 0")
    assert said["robot r_2"] == (1, "map 0; fleet/r_2/pose has the poses of r-2: rename one of both")


@pytest.mark.parametrize(("length_m", "count", "least", "most"), [(1.0, 101, 8, 12), (1000.0, 20_001, 3900, 5200)])
def test_the_path_is_thinned_and_a_long_one_has_longer_steps(network, published, length_m, count, least, most):
    poses = np.column_stack((np.linspace(0.0, length_m, count), np.zeros((count, 2))))
    published.path(1, np.arange(float(count)), poses)
    (path,) = network.sent["/robot1/path"]
    assert least <= len(path.poses) <= most
    assert path.poses[-1].pose.position.x == length_m


def test_stamps_grow_between_scans_up_to_the_bound():
    stream = TransformStream(bound_ns=SECOND, timeout_ns=SECOND // 5)
    assert stream.due(0) is None
    stream.add(100 * SECOND, 7 * SECOND, POSE)
    ahead = [stream.due(7 * SECOND + step * SECOND // 4) for step in range(8)]
    stamps = [due[0] / SECOND for due in ahead if due is not None]
    assert stamps == [100.2, 100.45, 100.7, 100.95, 101.2]


def test_stamps_never_go_back_but_after_a_restart():
    stream = TransformStream(bound_ns=SECOND, timeout_ns=0)
    stream.add(100 * SECOND, 0, POSE)
    assert stream.due(SECOND)[0] == 101 * SECOND
    stream.add(100 * SECOND + 1, SECOND, POSE)
    assert stream.due(SECOND) is None
    stream.add(50 * SECOND, 2 * SECOND, POSE)
    assert stream.due(9 * SECOND)[0] > 101 * SECOND
    stream.restart()
    stream.add(50 * SECOND, 10 * SECOND, POSE)
    assert stream.due(10 * SECOND)[0] == 50 * SECOND
