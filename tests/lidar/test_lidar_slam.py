"""One robot's SLAM: loops close where they should, twins stay apart, and the same recording gives the same bytes."""

import numpy as np
import pytest
from scipy.sparse.csgraph import csgraph_from_dense, dijkstra

from fcslam.geometry import se2
from fcslam.graph.optimizer import optimize
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lidar.backend import LidarBackend, chained
from fcslam.lidar.closing import MOST_NEARBY, _shortest_paths
from fcslam.lidar.frontend import LidarConfig, LidarFrontend, motion_information
from fcslam.lidar.odometry import WHEELS
from fcslam.lidar.tracker import TrackedScan
from fcslam.records import Constraint, ConstraintKind
from tests.lidar.worlds import box, chain, drifting, drive, path, pose_errors, recording, ring, ring_drive, shifted

pytestmark = pytest.mark.slow

DRIFT = {"scale": 1.03, "veer_rad_m": 0.015, "noise": 0.02}


class Mapped:
    """A recording mapped to the end."""

    def __init__(self, scans, config=None):
        config = config or LidarConfig()
        frontend, self.backend = LidarFrontend("r", config), LidarBackend("r", config)
        self.tracked, self.mapped, self.submaps = [], [], []
        for scan in scans:
            pose, keyscan = frontend.process(scan)
            self.tracked.append(pose)
            self.mapped.append(keyscan)
            if keyscan is not None:
                self.submaps += filter(None, [self.backend.add(keyscan)])
        self.submaps += self.backend.finish()
        self.travel = np.array([keyscan.travel_m for keyscan in filter(None, self.mapped)])
        self.keyscans = self.backend.keyscan_poses()

    @property
    def poses(self):
        offsets = np.array([pose.T_keyscan_base for pose in self.tracked])
        return se2.compose(self.keyscans[[pose.keyscan for pose in self.tracked]], offsets)

    @property
    def odometry(self):
        return [k.odometry for k in self.mapped if k is not None and k.odometry is not None]

    @property
    def closures(self):
        return [closure for submap in self.submaps for closure in submap.closures]

    def false_closures(self, truth, limit_m=0.5):
        """Closures whose measured motion is off the true one, by how much."""
        at = truth[[k for k, keyscan in enumerate(self.mapped) if keyscan is not None]]
        rest = [se2.between(se2.between(at[c.i], at[c.j]), c.T_i_j) for c in self.closures]
        return [(c.i, c.j, r) for c, r in zip(self.closures, rest, strict=True) if np.hypot(r[0], r[1]) > limit_m]


@pytest.fixture(scope="module")
def truth():
    return ring_drive()


@pytest.fixture(scope="module")
def scans(truth):
    return recording(truth, drifting(truth, np.random.default_rng(4), **DRIFT), ring())


@pytest.fixture(scope="module")
def mapped(scans):
    return Mapped(scans)


def test_a_loop_is_closed(truth, scans, mapped):
    odometry = pose_errors(np.array([scan.T_odom_base for scan in scans]), truth)[0]
    shift, turn = pose_errors(mapped.poses, truth)
    assert len(mapped.closures) >= 3
    assert mapped.false_closures(truth, 0.1) == []
    assert shift[-1] < 0.05
    assert np.rad2deg(turn[-1]) < 0.5
    assert shift.max() < 0.10
    assert odometry[-1] > 20 * shift[-1]


def test_every_scan_has_a_pose_and_every_keyscan_a_place_in_the_chain(scans, mapped):
    assert [pose.stamp for pose in mapped.tracked] == [scan.stamp for scan in scans]
    numbers = [keyscan.record.id.number for keyscan in mapped.mapped if keyscan is not None]
    assert numbers == list(range(len(mapped.keyscans)))
    assert {c.kind for c in mapped.odometry} == {ConstraintKind.ODOMETRY}
    assert {c.kind for c in mapped.closures} == {ConstraintKind.CLOSURE}
    assert [(c.i, c.j) for c in mapped.odometry] == [(k, k + 1) for k in range(len(numbers) - 1)]
    assert np.isfinite(mapped.poses).all()
    near = np.array([pose.T_keyscan_base for pose in mapped.tracked])
    assert np.hypot(*near[:, :2].T).max() < 0.4


def test_the_map_starts_at_the_first_odometry_pose(truth):
    start = np.array([5.0, -3.0, 2.0])
    poses = truth[:30]
    odometry = se2.compose(start, se2.between(poses[0], poses))
    mapped = Mapped(recording(poses, odometry, ring()))
    np.testing.assert_allclose(mapped.poses[0], start, atol=1e-12)
    rest = se2.between(odometry, mapped.poses)
    assert np.abs(rest).max() < 0.05


def test_submaps_cover_the_drive(mapped):
    anchors = [submap.anchor for submap in mapped.submaps]
    assert anchors == sorted(set(anchors))
    travel = mapped.travel
    assert np.diff(travel[anchors]).max() < 2.0 + 0.5
    for submap in mapped.submaps:
        assert submap.first <= submap.anchor <= submap.last
        assert travel[submap.last] - travel[submap.first] <= 10.0 + 1e-9
        assert len(submap.surface) > 100
    assert mapped.submaps[-1].last == len(travel) - 1


def test_information_of_a_motion_turns_with_the_robot():
    """Well fixed across, badly along the local y axis: seen from a robot that faces it, along is its own x."""
    information = np.diag((1e6, 1e1, 1e6))
    for heading in (0.0, np.pi / 2, 0.7):
        tracked = TrackedScan(np.array([1.0, 2.0, heading]), information, None)
        found = motion_information(np.array([0.3, 0.0, 0.1]), tracked, WHEELS)
        _, vectors = np.linalg.eigh(found[:2, :2])
        loose = np.array([np.sin(heading), np.cos(heading)])  # local y in the robot's base
        assert abs(vectors[:, 0] @ loose) > 0.999


def hotel(spacing_m, rooms=2):
    """A corridor with rooms off it that look exactly the same, inside and at the door."""
    furniture = [box(-1.6, 3.9, -0.9, 5.0), box(0.9, 2.2, 1.7, 2.8), path((0.5, 5.0), (1.8, 4.2))]
    walls = [path((-2, 1), (-0.5, 1)), path((0.5, 1), (2, 1)), path((-2, 1), (-2, 5), (2, 5), (2, 1)), *furniture]
    one = np.vstack(walls)
    front = [path((-6, -1), (spacing_m * (rooms - 1) + 6, -1)), path((-6, 1), (-2, 1))]
    between = [path((k * spacing_m + 2, 1), ((k + 1) * spacing_m - 2, 1)) for k in range(rooms - 1)]
    end = (rooms - 1) * spacing_m
    ends = [path((end + 2, 1), (end + 6, 1), (end + 6, -1)), path((-6, -1), (-6, 1))]
    return np.vstack([*front, *between, *ends, *(shifted(one, k * spacing_m, 0.0) for k in range(rooms))])


def visit(x):
    return [(x, 0.0), (x, 2.6), (x - 1.0, 3.2), (x + 0.2, 3.8), (x, 2.4), (x, 0.0)]


@pytest.fixture(scope="module")
def guest():
    """A drive through four rooms, and its scans."""
    spacing = 8.0
    stops = [stop for k in range(4) for stop in visit(k * spacing)]
    truth = drive([(-4.5, 0), *stops, (3 * spacing + 4.5, 0), (-4.5, 0)])
    odometry = drifting(truth, np.random.default_rng(3), **DRIFT)
    return truth, recording(truth, odometry, hotel(spacing, rooms=4))


def test_rooms_that_look_alike_stay_apart(guest):
    truth, scans = guest
    mapped = Mapped(scans)
    assert mapped.false_closures(truth) == []
    assert len(mapped.closures) > 0
    assert pose_errors(mapped.poses, truth)[0].max() < 0.05


def test_motions_combined_solve_as_the_keyscans_between_would():
    """A chain, one motion of which is loose, and a closure between its ends that disagrees."""
    rng = np.random.default_rng(0)
    motions = []
    for k in range(6):
        root = rng.normal(size=(3, 3))
        information = root @ root.T + np.diag((4e2, 4e2, 4e4)) * (0.01 if k == 2 else 1.0)
        motions.append(Constraint("r", k, k + 1, ConstraintKind.ODOMETRY, np.array([0.3, 0.02 * k, 0.25]), information))
    T, information = chained(motions)
    closure = se2.compose(T, np.array([0.02, -0.03, 0.01]))
    trust = np.diag((5e2, 3e2, 1e4))

    def end(edges, poses):
        graph = PoseGraph(poses, [*edges, Edge(0, len(poses) - 1, closure, trust, robust=False)])
        return optimize(graph).poses[-1]

    poses = list(chain([motion.T_i_j for motion in motions]))
    whole = end([Edge(m.i, m.j, m.T_i_j, m.information, robust=False) for m in motions], poses)
    reduced = end([Edge(0, 1, T, information, robust=False)], [poses[0], T])
    assert np.abs(se2.between(T, whole)).max() > 3e-3
    np.testing.assert_allclose(reduced, whole, atol=3e-4)


def test_what_is_forgotten_of_a_well_known_area_costs_no_closure_of_the_newest_visit():
    truth = drive([(1.5, 1.5), (6.0, 1.5)] * 9)
    mapped = Mapped(recording(truth, truth, ring()))
    assert len(mapped.submaps) > 3 * MOST_NEARBY
    assert all(submap.closures for submap in mapped.submaps[-6:])
    assert pose_errors(mapped.poses, truth)[0].max() < 0.05


def test_shortest_paths_are_those_of_dijkstra():
    rng = np.random.default_rng(0)
    steps, closures = rng.uniform(0.0, 3.0, 59), rng.integers(0, 60, (25, 2))
    ends = np.concatenate((np.stack((np.arange(59), np.arange(1, 60)), axis=1), closures))
    links = np.full((60, 60), np.inf)
    for (i, j), length in zip(ends, (*steps, *np.full(25, 1.0)), strict=True):
        links[i, j] = links[j, i] = min(links[i, j], length)
    for source in (0, 31, 59):
        paths = _shortest_paths(source, steps, closures, 1.0)
        np.testing.assert_allclose(paths, dijkstra(csgraph_from_dense(links, np.inf), indices=source), rtol=1e-12)
    assert _shortest_paths(0, np.empty(0), np.empty((0, 2), np.int64), 1.0) == [0.0]
