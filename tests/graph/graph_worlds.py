"""Small synthetic graphs with known truth, and an independent solver."""

import numpy as np
from scipy.optimize import least_squares

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


def least_squares_poses(graph: PoseGraph, poses: np.ndarray) -> np.ndarray:
    """Least-squares poses with variable 0 held, by SciPy's solver and numerical differentiation."""
    edges = graph.arrays()
    roots = np.linalg.cholesky(edges.information).transpose(0, 2, 1)

    def residuals(free: np.ndarray) -> np.ndarray:
        x = np.vstack((poses[:1], free.reshape(-1, 3)))
        errors = se2.between(edges.T_i_j, se2.between(x[edges.i], x[edges.j]))
        return np.einsum("nab,nb->na", roots, errors).ravel()

    found = least_squares(residuals, poses[1:].ravel(), jac="3-point")
    return np.vstack((poses[:1], found.x.reshape(-1, 3)))
