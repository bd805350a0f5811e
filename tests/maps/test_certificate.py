"""The certificate: covariances against sampled errors, and verdicts of graphs whose weak places are known."""

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag

from fcslam.geometry import se2, se3
from fcslam.geometry.groups import SE3
from fcslam.graph.optimizer import PosePrior, optimize
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.maps.certificate import (
    QUANTILE,
    QUIET,
    UNSEEN,
    MappedPath,
    certify,
    covariances,
)
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.metrics.trajectory import align, position_errors
from tests.graph.graph_worlds import gtsam_problem

COUNT = 40
BAR_M = 0.25 * QUIET * QUANTILE


def chain(sigma_m=0.01, sigma_rad=0.002, open_from=None, closures=(), rng=None, open_m=0.3):
    """A drive in a circle with one keyscan a metre; with ``rng``, its measurements have errors."""
    angles = 2.0 * np.pi * np.arange(COUNT) / COUNT
    radius = COUNT / (2.0 * np.pi)
    poses = np.stack((radius * np.sin(angles), radius * (1.0 - np.cos(angles)), angles), axis=-1)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    edges = []
    for i, j in [*zip(range(COUNT - 1), range(1, COUNT), strict=True), *closures]:
        along = open_m if open_from is not None and open_from <= i < open_from + 8 and j == i + 1 else sigma_m
        sigma = np.array((along, sigma_m, sigma_rad))
        motion = se2.between(poses[i], poses[j])
        if rng is not None:
            motion = se2.compose(motion, sigma * rng.standard_normal(3))
        edges.append(Edge(i, j, motion, np.diag(sigma**-2.0), j != i + 1))
    return PoseGraph(poses, edges), poses


def path(poses):
    return MappedPath(poses, np.arange(len(poses)))


def room(poses):
    """A map that is known around the drive."""
    low, high = np.floor(poses[:, :2].min(axis=0)) - 1.0, np.ceil(poses[:, :2].max(axis=0)) + 1.0
    cells = np.full(np.round((high - low) / 0.1).astype(int)[::-1], Occupancy.FREE, np.uint8)
    return OccupancyMap(cells, 0.1, tuple(low.tolist()))


def test_covariances_are_those_of_sampled_errors():
    rng = np.random.default_rng(0)
    closures = [(0, 20), (10, 30)]
    graph, poses = chain(closures=closures)
    places = covariances(graph, [path(poses)])
    samples = np.array([optimize(chain(closures=closures, rng=rng)[0]).poses for _ in range(60)])
    wrong = (samples - poses)[:, places.variables]
    wrong[..., 2] = (wrong[..., 2] + np.pi) % (2 * np.pi) - np.pi
    spread = np.sqrt((wrong[:, 1:] ** 2).mean(axis=0))
    expected = np.sqrt(np.diag(places.covariance)).reshape(-1, 3)[1:]
    assert np.allclose(spread, expected, rtol=0.35)
    bent = np.array([bend_of(sample[places.variables], places.poses, 10.0) for sample in samples])
    measured = np.sqrt((bent**2).mean(axis=0))
    assert np.allclose(measured, places.bend_m(10.0) / QUIET, rtol=0.35)


def test_a_map_that_is_moved_as_a_whole_is_not_bent():
    graph, poses = chain(sigma_m=1e-6, sigma_rad=1e-6)
    moved = covariances(graph, [path(poses)])
    turn = np.stack((-poses[moved.variables, 1], poses[moved.variables, 0], np.ones(len(moved.poses))), axis=-1).ravel()
    shift = np.tile((1.0, 0.5, 0.0), len(moved.poses))
    rigid = moved._replace(covariance=moved.covariance + np.outer(turn, turn) + np.outer(shift, shift))
    assert rigid.bend_m(10.0).max() < 1e-3


def test_covariances_are_those_of_gtsam():
    graph, poses = chain(closures=[(0, 20), (10, 30)])
    places = covariances(graph, [path(poses)])
    held = PosePrior(0, poses[0], 1e12 * np.eye(3))
    marginals = gtsam.Marginals(*gtsam_problem(graph, poses, priors=[held]))
    in_bodies = marginals.jointMarginalCovariance(places.variables.tolist()).fullMatrix()
    to_map = block_diag(*se2.adjoint(places.poses * (0.0, 0.0, 1.0)))
    expected = to_map @ in_bodies @ to_map.T
    assert places.covariance == pytest.approx(expected, rel=1e-5, abs=1e-10)


@pytest.mark.parametrize("closures", [[(i, i + 5) for i in range(30)], []])
def test_errors_are_larger_where_measurements_contradict_each_other(closures):
    exact, poses = chain(closures=closures)
    assert covariances(exact, [path(poses)]).scale == pytest.approx(QUIET, rel=1e-3)
    noisy, _ = chain(closures=closures, rng=np.random.default_rng(1))  # errors as large as the graph expects
    solved = optimize(noisy).poses
    edges = noisy.arrays()
    rows = zip(edges.i.tolist(), edges.j.tolist(), edges.T_i_j, edges.information, edges.robust.tolist(), strict=True)
    graph = PoseGraph(solved, [Edge(*row) for row in rows])
    scale = covariances(graph, [path(solved)]).scale
    assert scale == pytest.approx(1.0 if closures else QUIET, rel=0.25)


def test_errors_are_larger_where_scans_do_not_see_whether_the_wheels_slip():
    graph, poses = chain(sigma_m=0.3)
    assert covariances(graph, [path(poses)]).scale == pytest.approx(np.hypot(QUIET, UNSEEN))


def test_a_map_that_an_exact_plan_bent_is_as_good_as_before():
    graph, poses = chain(closures=[(i, i + 5) for i in range(30)])
    bent = poses * (1.02, 1.0, 1.0)
    before, after = covariances(graph, [path(poses)]), covariances(PoseGraph(bent, graph.edges), [path(bent)], graph)
    assert after.bend_m(10.0).mean() == pytest.approx(before.bend_m(10.0).mean(), rel=0.05)


def test_a_ramp_is_no_contradiction():
    pitch_rad = np.where(np.arange(COUNT) < COUNT // 2, 0.0, -0.2)  # up from the middle on
    turns = np.stack((0 * pitch_rad, np.sin(pitch_rad / 2), 0 * pitch_rad, np.cos(pitch_rad / 2)), axis=-1)
    steps = np.stack((np.cos(pitch_rad), 0 * pitch_rad, -np.sin(pitch_rad)), axis=-1)
    poses = np.concatenate((np.cumsum(steps, axis=0), turns), axis=-1)
    information = np.diag((1e4, 1e4, 1e4, 2.5e5, 2.5e5, 2.5e5))
    edges = [Edge(i, i + 1, se3.between(poses[i], poses[i + 1]), information, False) for i in range(COUNT - 1)]
    space = PoseGraph(poses, edges, SE3)
    flat = space.to_plane()
    paths = [path(flat.poses())]
    assert covariances(flat, paths, space).scale == pytest.approx(QUIET, rel=1e-3)
    assert covariances(flat, paths).scale.max() > 1.5 * QUIET


def bend_of(poses, truth, within_m):
    """Root mean square error of the positions around each pose, after the best rigid alignment."""
    errors = []
    for place in truth:
        near = np.hypot(*(truth[:, :2] - place[:2]).T) <= within_m
        T = align(truth[near], poses[near])
        errors.append(np.sqrt((position_errors(T, truth[near], poses[near]) ** 2).mean()))
    return np.array(errors)


def test_a_closure_makes_cells_good_and_an_open_stretch_makes_them_bad():
    certificates = [
        certify(graph, [path(poses)], room(poses), bar_m=0.0033 * QUANTILE)
        for graph, poses in (chain(), chain(closures=[(0, 39), (5, 34)]), chain(open_from=12))
    ]
    plain, closed, is_open = (one["good_share"] for one in certificates)
    assert closed > plain > is_open


def test_a_length_that_neither_wheels_nor_scans_measure_is_not_known_unless_closures_tell_it():
    unknown, told = (
        certify(graph, [path(poses)], room(poses))
        for graph, poses in (
            chain(open_from=12, open_m=0.5),
            chain(open_from=12, open_m=0.5, closures=[(i, i + 2) for i in range(10, 20)]),
        )
    )
    assert unknown["error_95"] == unknown["within"]
    assert told["error_95"] < 1.0


def test_what_to_drive_again_brings_what_it_promises():
    graph, poses = chain(open_from=12)
    certificate = certify(graph, [path(poses)], room(poses), bar_m=BAR_M)
    drive = certificate["drives"][0]
    ends = [int(np.argmin(np.hypot(*(poses[:, :2] - drive[end]).T))) for end in ("from", "to")]
    drift = covariances(graph, [path(poses)]).drift[ends[1]]
    apart_m = float(np.hypot(*(poses[ends[0], :2] - poses[ends[1], :2])))
    turn = se2.adjoint(poses[ends[1]] * (0.0, 0.0, -1.0))
    again = Edge(*ends, se2.between(poses[ends[0]], poses[ends[1]]),
                 np.linalg.inv(turn @ (apart_m * drift) @ turn.T + 1e-9 * np.eye(3)), True)  # fmt: skip
    better = certify(PoseGraph(poses, [*graph.edges, again]), [path(poses)], room(poses), bar_m=BAR_M)
    gained = sum(cell["good"] for cell in better["cells"]) - sum(cell["good"] for cell in certificate["cells"])
    assert gained == pytest.approx(drive["gain_m2"], rel=0.25)


def test_what_no_edge_connects_with_the_first_keyscan_is_unknown_and_itself_as_good_as_alone():
    graph, poses = chain()
    apart = poses + np.array((30.0, 0.0, 0.0))
    edges = [Edge(e.i + COUNT, e.j + COUNT, e.T_i_j, e.information, e.robust) for e in graph.edges]
    both = PoseGraph(np.concatenate((poses, apart)), [*graph.edges, *edges])
    paths = [path(poses), path(apart)._replace(variables=np.arange(COUNT, 2 * COUNT))]
    alone, places = covariances(graph, [path(poses)]), covariances(both, paths)
    second = places.variables >= COUNT
    assert second.any()
    assert places.bend_m(10.0)[~second] == pytest.approx(alone.bend_m(10.0), rel=1e-3)
    assert places.bend_m(60.0).min() > 1.0, "both together"
    own = covariances(PoseGraph(apart, graph.edges), [path(apart)])
    assert places.bend_m(10.0)[second] == pytest.approx(own.bend_m(10.0), rel=1e-3)


def test_the_bar_is_a_cell_of_the_map():
    graph, poses = chain()
    certificate = certify(graph, [path(poses)], room(poses))
    assert certificate["bar"] == 0.1, "a cell of the map"
    assert certificate["good_share"] == np.mean([cell["good"] for cell in certificate["cells"]])
