"""A robot's trajectory with drift: poses, and the covariance of the motion between any two of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.geometry import se2
from fcslam.records import FloatArray

DRIFT = 0.02, 0.02, 0.005
"""Standard deviation of the drift in x, y (metres) and heading (radians) after one metre of travel, on top of the
covariance of the odometry: a random walk along the path."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one robot in the order of its path, in the robot's own coordinate frame."""

    poses: FloatArray
    """Shape (N, 3): x, y, theta in metres and radians."""
    travel_m: FloatArray
    """Path length up to each pose, metres, shape (N,)."""
    _covariance: FloatArray
    """Covariance accumulated up to each pose, in the tangent space at ``_centre``, shape (N, 3, 3)."""
    _centre: FloatArray
    """Pose at the mean position of the trajectory, shape (3,)."""

    def __len__(self) -> int:
        return len(self.poses)

    def drift(self, start: NDArray[np.int64], end: NDArray[np.int64]) -> FloatArray:
        """Covariance (P, 3, 3) of the motions between the poses of two rows each, in the tangent space at ``end``."""
        low, high = np.minimum(start, end), np.maximum(start, end)
        return transport_covariance(
            self._covariance[high] - self._covariance[low], se2.between(self._centre, self.poses[end])
        )


def build_trajectory(poses: ArrayLike, step_covariance: ArrayLike | None = None) -> Trajectory:
    """Accumulate the covariance along a path of poses (N, 3), that of ``DRIFT`` included.

    ``step_covariance`` is that of each step in the tangent space at its end, shape (N - 1, 3, 3); None takes the steps
    as exact.
    """
    x = np.asarray(poses, dtype=np.float64).reshape(-1, 3)
    length = np.hypot(*np.diff(x[:, :2], axis=0).T)
    spread = length[:, None, None] * np.diag(np.square(DRIFT))
    if step_covariance is not None:
        spread += np.asarray(step_covariance, dtype=np.float64)
    # Lever arms start at the middle of the path: from a distant origin they would cost precision.
    centre = np.append(x[:, :2].mean(axis=0), 0.0) if len(x) else np.zeros(3)
    adjoint = se2.adjoint(se2.between(centre, x[1:]))
    steps = adjoint @ spread @ adjoint.swapaxes(-1, -2)
    accumulated = np.concatenate((np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)))
    return Trajectory(x, np.append(0.0, np.cumsum(length)), accumulated, centre)


def transport_covariance(covariance: FloatArray, T: FloatArray) -> FloatArray:
    """Move a covariance (..., 3, 3) from the tangent space before a motion ``T`` (..., 3) to the one after it."""
    adjoint = se2.adjoint(se2.inverse(T))
    moved: FloatArray = adjoint @ covariance @ adjoint.swapaxes(-1, -2)
    return moved
