"""A robot's path as consistency sees it: poses, and how uncertain the motion between any two of them is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.records import FloatArray


class DriftSettings(Settings):
    """What a robot's path may be off beyond what its own measurements say: a random walk per metre."""

    position_drift_m: float = Field(
        default=0.02, gt=0.0, description="Standard deviation of a trajectory's position after one metre"
    )
    heading_drift_rad: float = Field(
        default=0.005, gt=0.0, description="Standard deviation of a trajectory's heading after one metre"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one robot in the order of its path, in a frame of its own."""

    poses: FloatArray
    """Shape (N, 3)."""
    metres: FloatArray
    """Path length up to each pose, shape (N,)."""
    _walk: FloatArray
    """Covariance of the path up to each pose, in the tangent space at the poses' centre, shape (N, 3, 3)."""
    _centre: FloatArray

    def __len__(self) -> int:
        return len(self.poses)

    def drift(self, start: NDArray[np.int64], end: NDArray[np.int64]) -> FloatArray:
        """Covariance (P, 3, 3) of the motions from ``start`` to ``end`` (P,), in the tangent space at the end."""
        low, high = np.minimum(start, end), np.maximum(start, end)
        return carried(self._walk[high] - self._walk[low], se2.between(self._centre, self.poses[end]))


def trajectory(poses: ArrayLike, settings: DriftSettings, step_covariance: ArrayLike | None = None) -> Trajectory:
    """A trajectory of ``poses`` (N, 3) that drifts as its steps' covariance (N - 1, 3, 3) and ``settings`` say.

    A step's covariance is in the tangent space at its end; without one the steps themselves count as exact.
    """
    x = np.asarray(poses, dtype=np.float64).reshape(-1, 3)
    length = np.hypot(*np.diff(x[:, :2], axis=0).T)
    per_metre = np.array((settings.position_drift_m, settings.position_drift_m, settings.heading_drift_rad)) ** 2
    spread = length[:, None, None] * np.diag(per_metre)
    if step_covariance is not None:
        spread += np.asarray(step_covariance, dtype=np.float64)
    # Levers are taken from the middle of the path: from a far origin they would eat the digits.
    centre = np.append(x[:, :2].mean(axis=0), 0.0) if len(x) else np.zeros(3)
    adjoint = se2.adjoint(se2.between(centre, x[1:]))
    steps = adjoint @ spread @ adjoint.swapaxes(-1, -2)
    walk = np.concatenate((np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)))
    return Trajectory(x, np.append(0.0, np.cumsum(length)), walk, centre)


def carried(covariance: FloatArray, T: FloatArray) -> FloatArray:
    """Covariance (..., 3, 3) in the tangent space before the motion ``T``, in the one after it."""
    adjoint = se2.adjoint(se2.inverse(T))
    moved: FloatArray = adjoint @ covariance @ adjoint.swapaxes(-1, -2)
    return moved
