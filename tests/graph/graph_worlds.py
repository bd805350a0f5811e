"""Small synthetic graphs with known truth, and an independent solver."""

from collections.abc import Sequence
from dataclasses import fields

import gtsam
import numpy as np

from fcslam.geometry import se2, se3
from fcslam.geometry.groups import SE2
from fcslam.graph.least_squares import CAUCHY_WIDTH, Loss
from fcslam.graph.optimizer import PosePrior
from fcslam.graph.pose_graph import Edge, PoseGraph

COVARIANCE = np.array([[9e-4, 2e-4, 3e-5], [2e-4, 4e-4, -2e-5], [3e-5, -2e-5, 2.5e-5]])
INFORMATION = np.linalg.inv(COVARIANCE)


def walk(seed: int, steps: int, side: int = 8) -> np.ndarray:
    """True poses of a walk on the streets of a grid, 1 m a step, shape (steps + 1, 3)."""
    generator = np.random.default_rng(seed)
    poses = [np.zeros(3)]
    for _ in range(steps):
        for turn in generator.permutation([0.0, 0.0, 0.0, np.pi / 2, -np.pi / 2, np.pi]):
            ahead = se2.compose(poses[-1], (0.0, 0.0, turn))
            ahead = se2.compose(ahead, (1.0, 0.0, 0.0))
            if np.abs(ahead[:2] - side / 2).max() <= side / 2 + 0.1:
                break
        poses.append(ahead)
    return np.array(poses)


def measured(generator: np.random.Generator, T_i_j: np.ndarray) -> np.ndarray:
    return se2.compose(T_i_j, se2.exp(generator.multivariate_normal(np.zeros(3), COVARIANCE)))


def manhattan(
    seed: int, steps: int = 150, closures: int = 60, outlier_share: float = 0.0
) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """Graph at its odometry's poses, true poses, and which edges are true."""
    generator = np.random.default_rng(seed)
    truth = walk(seed, steps)
    edges = [
        Edge(k, k + 1, measured(generator, se2.between(truth[k], truth[k + 1])), INFORMATION, False)
        for k in range(steps)
    ]
    near = [
        (i, j) for i in range(steps + 1) for j in range(i + 5, steps + 1) if np.hypot(*(truth[i] - truth[j])[:2]) < 1.5
    ]
    for k in generator.choice(len(near), min(closures, len(near)), replace=False):
        i, j = near[k]
        edges.append(Edge(i, j, measured(generator, se2.between(truth[i], truth[j])), INFORMATION, True))
    true_count = len(edges)
    false_count = round((true_count - steps) * outlier_share / (1.0 - outlier_share))
    for _ in range(false_count):
        i, j = sorted(generator.choice(steps + 1, 2, replace=False))
        wrong = np.append(generator.normal(0.0, 1.0, 2), generator.uniform(-np.pi, np.pi))
        edges.append(Edge(int(i), int(j), wrong, INFORMATION, True))
    drifted = [np.zeros(3)]
    for edge in edges[:steps]:
        drifted.append(se2.compose(drifted[-1], edge.T_i_j))
    return PoseGraph(np.array(drifted), edges), truth, np.arange(len(edges)) < true_count


def gtsam_pose(T: np.ndarray) -> gtsam.Pose2 | gtsam.Pose3:
    return gtsam.Pose2(*T) if len(T) == 3 else gtsam.Pose3(gtsam.Rot3(se3.rotation(T)), T[:3])


def gtsam_problem(
    graph: PoseGraph, poses: np.ndarray, loss: Loss = Loss.SQUARED, priors: Sequence[PosePrior] = ()
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """GTSAM's factors and values; without priors, the first variable has one at its pose."""
    edges, problem, values, noise = graph.arrays(), gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel
    kind, order = ("Pose2", [0, 1, 2]) if graph.group is SE2 else ("Pose3", [3, 4, 5, 0, 1, 2])  # turns come first
    between, prior_of = getattr(gtsam, f"BetweenFactor{kind}"), getattr(gtsam, f"PriorFactor{kind}")
    for k, pose in enumerate(poses):
        values.insert(k, gtsam_pose(pose))
    for i, j, T_i_j, information, robust in zip(*(getattr(edges, field.name) for field in fields(edges)), strict=True):
        model = noise.Gaussian.Information(information[np.ix_(order, order)], False)
        if robust and loss is Loss.CAUCHY:
            model = noise.Robust.Create(noise.mEstimator.Cauchy.Create(CAUCHY_WIDTH), model)
        problem.push_back(between(i, j, gtsam_pose(T_i_j), model))
    for prior in priors:
        axes = gtsam.Pose2(*prior.pose).matrix() * ((1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        model = noise.Gaussian.Information(axes.T @ prior.information @ axes, False)
        problem.push_back(prior_of(prior.variable, gtsam_pose(prior.pose), model))
    if not priors:
        exact = noise.Gaussian.Information(1e8 * np.eye(len(order)), False)
        problem.push_back(prior_of(0, gtsam_pose(poses[0]), exact))
    return problem, values


def gtsam_optimum(
    graph: PoseGraph, start: np.ndarray, loss: Loss = Loss.SQUARED, priors: Sequence[PosePrior] = ()
) -> tuple[np.ndarray, float]:
    """The poses (N, P) of GTSAM, and their cost."""
    problem, values = gtsam_problem(graph, start, loss, priors)
    found = exactly_solved(problem, values)
    if graph.group is SE2:
        return gtsam.utilities.extractPose2(found), problem.error(found)
    return np.array([se3.from_matrix(found.atPose3(k).matrix()) for k in range(len(graph))]), problem.error(found)


def exactly_solved(problem: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    return gtsam.LevenbergMarquardtOptimizer(problem, start, parameters).optimize()
