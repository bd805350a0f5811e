"""Poses of a pose graph whose variables are also measured in a frame outside of it: by a floor plan, by satellites."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache, from_values, to_values
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """A measured pose of one variable."""

    variable: int
    pose: FloatArray
    """Shape (3,), metres and radians."""
    information: FloatArray
    """Inverse covariance in the coordinates of the frame outside (x, y) and of the heading, shape (3, 3)."""

    def chi2(self, poses: FloatArray) -> float:
        """Squared Mahalanobis distance of the poses (N, 3)."""
        residual = poses[self.variable] - self.pose
        residual[2] = se2.wrap_angle(residual[2])
        return float(residual @ self.information @ residual)


def optimize_anchored(graph: PoseGraph, initial: FloatArray, priors: Sequence[PosePrior]) -> FloatArray:
    """Optimize a pose graph, all of whose edges count, with priors; returns poses (N, 3) in the frame of the priors.

    The poses to start from, shape (N, 3), are in this frame, too. Each connected component has priors that fix its
    pose.
    """
    problem = FactorCache(graph).floating(np.ones(int(graph.arrays().robust.sum())))
    for prior in priors:
        turn = np.eye(3)
        cos, sin = np.cos(prior.pose[2]), np.sin(prior.pose[2])
        turn[:2, :2] = ((cos, -sin), (sin, cos))
        noise = gtsam.noiseModel.Gaussian.Information(turn.T @ prior.information @ turn, False)
        problem.push_back(gtsam.PriorFactorPose2(prior.variable, gtsam.Pose2(*prior.pose.tolist()), noise))
    return from_values(gtsam.LevenbergMarquardtOptimizer(problem, to_values(initial)).optimize())
