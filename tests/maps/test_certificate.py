"""The certificate: covariances against sampled errors, and verdicts of graphs whose weak places are known."""

import json

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag

from fcslam.geometry import se2
from fcslam.graph.optimizer import PosePrior, optimize
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.maps.certificate import (
    AGAIN_M,
    AGAIN_PER_M,
    CONTRADICTED,
    FLOOR_M,
    SCALE,
    MappedPath,
    certificate_json,
    certificate_png,
    certify,
    covariances,
    relative_error,
)
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from tests.graph.graph_worlds import gtsam_problem

COUNT = 40
BAR_M = 0.25 * SCALE + FLOOR_M


def chain(sigma_m=0.01, sigma_rad=0.002, open_from=None, closures=(), rng=None):
    """A drive in a circle with one keyscan a metre; with ``rng``, its measurements have errors."""
    angles = 2.0 * np.pi * np.arange(COUNT) / COUNT
    radius = COUNT / (2.0 * np.pi)
    poses = np.stack((radius * np.sin(angles), radius * (1.0 - np.cos(angles)), angles), axis=-1)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    edges = []
    for i, j in [*zip(range(COUNT - 1), range(1, COUNT), strict=True), *closures]:
        along = 0.3 if open_from is not None and open_from <= i < open_from + 8 and j == i + 1 else sigma_m
        sigma = np.array((along, sigma_m, sigma_rad))
        motion = se2.between(poses[i], poses[j])
        if rng is not None:
            motion = se2.compose(motion, sigma * rng.standard_normal(3))
        edges.append(Edge(i, j, motion, np.diag(sigma**-2.0), j != i + 1))
    return PoseGraph(poses, edges), poses


def path(poses):
    return MappedPath("a", np.arange(float(len(poses))), poses, np.arange(len(poses)))


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
    expected = np.sqrt(np.diag(places.covariance)).reshape(-1, 3)[1:] / SCALE
    assert np.allclose(spread, expected, rtol=0.35)
    seen = np.array([relative_of(sample[places.variables], places.poses, 10.0) for sample in samples])
    measured = np.sqrt((seen**2).mean(axis=0))
    predicted = np.sqrt(relative_error(places.poses, places.covariance, 10.0) ** 2 - FLOOR_M**2) / SCALE
    assert np.allclose(measured, predicted, rtol=0.35)


def test_covariances_are_those_of_gtsam():
    graph, poses = chain(closures=[(0, 20), (10, 30)])
    places = covariances(graph, [path(poses)])
    held = PosePrior(0, poses[0], 1e12 * np.eye(3))
    marginals = gtsam.Marginals(*gtsam_problem(graph, poses, priors=[held]))
    in_bodies = marginals.jointMarginalCovariance(places.variables.tolist()).fullMatrix()
    to_map = block_diag(*se2.adjoint(places.poses * (0.0, 0.0, 1.0)))
    expected = SCALE**2 * to_map @ in_bodies @ to_map.T
    assert places.covariance == pytest.approx(expected, rel=1e-6, abs=1e-10)


@pytest.mark.parametrize("closures", [[(i, i + 5) for i in range(30)], []])
def test_errors_are_larger_where_measurements_contradict_each_other(closures):
    exact, poses = chain(closures=closures)
    assert covariances(exact, [path(poses)]).scale == SCALE
    noisy, _ = chain(closures=closures, rng=np.random.default_rng(1))  # errors as large as the graph expects
    solved = optimize(noisy).poses
    edges = noisy.arrays()
    rows = zip(edges.i.tolist(), edges.j.tolist(), edges.T_i_j, edges.information, edges.robust.tolist(), strict=True)
    graph = PoseGraph(solved, [Edge(*row) for row in rows])
    scale = covariances(graph, [path(solved)]).scale
    assert scale == (pytest.approx(CONTRADICTED, rel=0.25) if closures else SCALE)


def relative_of(poses, truth, within_m):
    """Root mean square error of the positions around each pose as seen from it."""
    errors = []
    for k in range(len(truth)):
        near = (np.hypot(*(truth[:, :2] - truth[k, :2]).T) <= within_m) & (np.arange(len(truth)) != k)
        wrong = se2.between(poses[k], poses[near])[:, :2] - se2.between(truth[k], truth[near])[:, :2]
        errors.append(np.sqrt((wrong**2).sum(axis=1).mean()))
    return np.array(errors)


def test_a_closure_makes_cells_good_and_an_open_stretch_makes_them_bad():
    certificates = [
        certify(graph, [path(poses)], room(poses), bar_m=0.1 * SCALE + FLOOR_M)
        for graph, poses in (chain(), chain(closures=[(0, 39), (5, 34)]), chain(open_from=12))
    ]
    plain, closed, is_open = (one["good_share"] for one in certificates)
    assert closed > plain > is_open
    (stretch,) = certificates[2]["open_stretches"]
    assert stretch["length"] == pytest.approx(8.0, abs=0.2)
    assert (stretch["first"], stretch["last"]) == (12.0, 20.0)
    assert certificates[0]["open_stretches"] == []


def test_what_to_drive_again_brings_what_it_promises():
    graph, poses = chain(open_from=12)
    certificate = certify(graph, [path(poses)], room(poses), bar_m=BAR_M)
    drive = certificate["drives"][0]
    ends = [int(np.argmin(np.hypot(*(poses[:, :2] - drive[end]).T))) for end in ("from", "to")]
    sigma = AGAIN_M / SCALE + AGAIN_PER_M / SCALE * float(np.hypot(*(poses[ends[0], :2] - poses[ends[1], :2])))
    again = Edge(*ends, se2.between(poses[ends[0]], poses[ends[1]]),
                 np.diag((sigma**-2, sigma**-2, (sigma / 5.0) ** -2)), True)  # fmt: skip
    better = certify(PoseGraph(poses, [*graph.edges, again]), [path(poses)], room(poses), bar_m=BAR_M)
    gained = sum(cell["good"] for cell in better["cells"]) - sum(cell["good"] for cell in certificate["cells"])
    assert gained == pytest.approx(drive["gain_m2"], rel=0.25)


def test_passes_and_the_last_look_are_counted():
    graph, poses = chain()
    later = MappedPath("a", np.where(np.arange(COUNT) < 20, np.arange(COUNT), np.arange(COUNT) + 100.0), poses,
                       np.arange(COUNT))  # fmt: skip
    cells = certify(graph, [later], room(poses))["cells"]
    assert {cell["passes"] for cell in cells} <= {0, 1, 2}
    assert sum(cell["passes"] == 2 for cell in cells) > 5, "around both ends of the gap"
    assert max(cell["last_seen"] for cell in cells if cell["passes"]) == 139.0
    assert all((cell["last_seen"] is None) == (cell["passes"] == 0) for cell in cells)


def test_what_no_edge_connects_with_the_first_keyscan_is_unknown_and_itself_as_good_as_alone():
    graph, poses = chain()
    apart = poses + np.array((30.0, 0.0, 0.0))
    edges = [Edge(e.i + COUNT, e.j + COUNT, e.T_i_j, e.information, e.robust) for e in graph.edges]
    both = PoseGraph(np.concatenate((poses, apart)), [*graph.edges, *edges])
    paths = [path(poses), path(apart)._replace(variables=np.arange(COUNT, 2 * COUNT))]
    alone, places = covariances(graph, [path(poses)]), covariances(both, paths)
    second = places.variables >= COUNT
    assert second.any()
    assert places.absolute_m()[~second] == pytest.approx(alone.absolute_m(), rel=1e-6)
    assert (places.absolute_m()[second] > 10.0).all()
    own = covariances(PoseGraph(apart, graph.edges), [path(apart)])
    assert places.relative_m(10.0)[second] == pytest.approx(own.relative_m(10.0), rel=1e-3)


def test_a_place_without_neighbours_is_as_good_as_the_nearest_one_says():
    poses = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (50.0, 0.0, 0.0)])
    covariance = np.diag((0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 16.0, 9.0, 0.0))
    assert relative_error(poses, covariance, 10.0)[2] == pytest.approx(np.sqrt(25.0 + 2.0), abs=1e-3)
    assert relative_error(poses[:1], covariance[:3, :3], 10.0)[0] == FLOOR_M


def test_it_is_written_as_json_and_as_a_picture():
    graph, poses = chain()
    certificate = certify(graph, [path(poses)], room(poses))
    content = json.loads(certificate_json({0: certificate}), parse_constant=pytest.fail)
    assert content["0"]["verdict"].endswith("m2 are good to 0.05 m within 10 m")
    assert certificate_png(certificate, room(poses)).startswith(b"\x89PNG")
