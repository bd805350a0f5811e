"""Small synthetic graphs with known truth, and an independent Gauss-Newton solver."""

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import spsolve

from fcslam.geometry import se2
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


def gauss_newton(graph: PoseGraph, poses: np.ndarray, rounds: int = 30) -> np.ndarray:
    """Least-squares poses with variable 0 held, by numerical differentiation edge by edge: slow and plain."""
    x = np.array(poses)
    for _ in range(rounds):
        rows, columns, entries, residuals = [], [], [], []
        for number, edge in enumerate(graph.edges):
            root = np.linalg.cholesky(edge.information).T

            def residual(a: np.ndarray, b: np.ndarray, edge: Edge = edge, root: np.ndarray = root) -> np.ndarray:
                return root @ se2.between(edge.T_i_j, se2.between(a, b))

            residuals.append(residual(x[edge.i], x[edge.j]))
            for axis in range(3):
                h = 1e-6 * np.eye(3)[axis]
                slopes = (
                    (edge.i, residual(x[edge.i] + h, x[edge.j]) - residual(x[edge.i] - h, x[edge.j])),
                    (edge.j, residual(x[edge.i], x[edge.j] + h) - residual(x[edge.i], x[edge.j] - h)),
                )
                for variable, slope in slopes:
                    rows += [3 * number, 3 * number + 1, 3 * number + 2]
                    columns += [3 * variable + axis] * 3
                    entries += (slope / 2e-6).tolist()
        J = csc_array((entries, (rows, columns)), shape=(3 * len(graph.edges), 3 * len(graph)))[:, 3:]
        step = spsolve((J.T @ J).tocsc(), -J.T @ np.concatenate(residuals)).reshape(-1, 3)
        x[1:] += step
        if np.abs(step).max() < 1e-9:
            break
    return x
