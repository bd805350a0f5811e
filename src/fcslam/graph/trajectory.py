"""A robot's trajectory with drift: poses, and the covariance of the motion between any two of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.geometry.groups import group_of
from fcslam.records import FloatArray

DRIFT = 0.02, 0.005
"""Standard deviations of the drift, metres and radians, in each direction after one metre of travel, on top of the
covariance of the odometry: a random walk along the path."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one robot in the order of its path, in the robot's own coordinate frame."""

    poses: FloatArray
    """Shape (N, P)."""
    travel_m: FloatArray
    """Path length up to each pose, metres, shape (N,)."""
    _covariance: FloatArray
    """Covariance accumulated up to each pose, in the tangent space at ``_centre``, shape (N, d, d)."""
    _centre: FloatArray
    """Pose at the mean position of the trajectory, shape (P,)."""

    def __len__(self) -> int:
        return len(self.poses)

    def drift(self, start: NDArray[np.int64], end: NDArray[np.int64]) -> FloatArray:
        """Covariance (K, d, d) of the motions between the poses of two rows each, in the tangent space at ``end``."""
        low, high = np.minimum(start, end), np.maximum(start, end)
        return transport_covariance(
            self._covariance[high] - self._covariance[low], group_of(self.poses).between(self._centre, self.poses[end])
        )


def build_trajectory(poses: ArrayLike, step_covariance: ArrayLike | None = None) -> Trajectory:
    """Accumulate the covariance along a path of poses (N, P), that of ``DRIFT`` included.

    ``step_covariance`` is that of each step in the tangent space at its end, (N - 1, d, d); None: steps are exact.
    """
    x = np.asarray(poses, dtype=np.float64)
    group, (sigma_m, sigma_rad) = group_of(x), DRIFT
    length = group.shift_m(np.diff(x, axis=0))
    spread = length[:, None, None] * np.diag(np.square(group.sigmas(sigma_m, sigma_rad)))
    if step_covariance is not None:
        spread += np.asarray(step_covariance, dtype=np.float64)
    # Lever arms start at the middle of the path: from a distant origin they would cost precision.
    centre = group.identity.copy()
    centre[: group.axes] = x[:, : group.axes].mean(axis=0) if len(x) else 0.0
    adjoint = group.adjoint(group.between(centre, x[1:]))
    steps = adjoint @ spread @ adjoint.swapaxes(-1, -2)
    accumulated = np.concatenate((np.zeros((1, group.freedom, group.freedom)), np.cumsum(steps, axis=0)))
    return Trajectory(x, np.append(0.0, np.cumsum(length)), accumulated, centre)


def transport_covariance(covariance: FloatArray, T: FloatArray) -> FloatArray:
    """Move a covariance (..., d, d) from the tangent space before a motion ``T`` (..., P) to the one after it."""
    group = group_of(T)
    adjoint = group.adjoint(group.inverse(T))
    moved: FloatArray = adjoint @ covariance @ adjoint.swapaxes(-1, -2)
    return moved
