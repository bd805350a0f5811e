"""Pairwise consistency of closures between two trajectories (PCM, Mangelson et al., ICRA 2018).

Two closures agree if the loop they form with the two stretches of trajectory between them closes, within their own
covariances and the drift of both stretches. Which frame the trajectories have to each other plays no part.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import gammaincinv

from fcslam.geometry import se2
from fcslam.graph.trajectory import DriftSettings, Trajectory, carried
from fcslam.records import FloatArray

_PAIRS_AT_ONCE = 100_000


class ConsistencySettings(DriftSettings):
    """When closures between two trajectories agree, and when their agreement is enough to join two maps."""

    probability: float = Field(
        default=0.99, gt=0.0, lt=1.0, description="Two true closures pass the chi-square test with this probability"
    )
    minimum_closures: int = Field(default=3, ge=1, description="Supporters needed, from places that lie apart")
    separation_m: float = Field(default=3.0, ge=0.0, description="Distance from which two places lie apart")
    lead: float = Field(default=2.0, ge=1.0, description="Size needed, as a multiple of the second largest cluster")
    witness_m: float = Field(
        default=10.0, ge=0.0, description="Closures are witnesses to each other up to this path length at both ends"
    )

    @property
    def limit(self) -> float:
        """The chi-square quantile of ``probability`` for the three degrees of freedom of a loop."""
        return float(2.0 * gammaincinv(1.5, self.probability))


@dataclass(frozen=True, slots=True, eq=False)
class Closures:
    """Closures between keyscans of a trajectory a and a trajectory b, one row each."""

    i: NDArray[np.int64]
    """Keyscan of a, shape (K,)."""
    j: NDArray[np.int64]
    """Keyscan of b, shape (K,)."""
    T_i_j: FloatArray
    """Shape (K, 3)."""
    information: FloatArray
    """Shape (K, 3, 3), in the tangent space at T_i_j."""

    def __len__(self) -> int:
        return len(self.i)

    def turned(self, rows: NDArray[np.bool_]) -> "Closures":
        """The same closures, those in ``rows`` (K,) told from their other end."""
        # The tangent space moves from j to i: v_i = -Ad(T_i_j) v_j.
        back = np.linalg.inv(se2.adjoint(self.T_i_j[rows]))
        i, j = np.where(rows, self.j, self.i), np.where(rows, self.i, self.j)
        T_i_j, information = self.T_i_j.copy(), self.information.copy()
        T_i_j[rows] = se2.inverse(self.T_i_j[rows])
        information[rows] = back.swapaxes(-1, -2) @ self.information[rows] @ back
        return Closures(i, j, T_i_j, information)

    def only(self, rows: NDArray[np.int64]) -> "Closures":
        """Some of them."""
        return Closures(self.i[rows], self.j[rows], self.T_i_j[rows], self.information[rows])


def pairwise_consistency(
    a: Trajectory, b: Trajectory, closures: Closures, settings: ConsistencySettings
) -> NDArray[np.bool_]:
    """Which closures agree, (K, K), symmetric, true on the diagonal.

    Raises:
        ValueError: a closure names a keyscan that its trajectory does not have.
    """
    _check(closures.i, len(a), "a")
    _check(closures.j, len(b), "b")
    k, m = np.triu_indices(len(closures), 1)
    agree = np.eye(len(closures), dtype=bool)
    for part in np.array_split(np.arange(len(k)), len(k) // _PAIRS_AT_ONCE + 1):  # memory must not follow K^2
        agree[k[part], m[part]] = loop_chi2(a, b, closures, k[part], m[part]) <= settings.limit
    return agree | agree.T


def witnesses(a: Trajectory, b: Trajectory, closures: Closures, settings: ConsistencySettings) -> NDArray[np.int64]:
    """How many other closures bear each one out, shape (K,). For closures within one robot, a and b are its path.

    A witness agrees and is near along the path at both ends, where hardly any drift could explain an agreement:
    where robots meet they close more than one loop, while a false closure stands alone.
    """
    if a is b:
        closures = closures.turned(closures.i > closures.j)
    near = np.ones((len(closures), len(closures)), dtype=bool)
    for path, end in ((a, closures.i), (b, closures.j)):
        metres = path.metres[end]
        near &= np.abs(metres[:, None] - metres[None]) <= settings.witness_m
    k, m = np.nonzero(np.triu(near, 1))
    agree = loop_chi2(a, b, closures, k, m) <= settings.limit
    return np.bincount(np.concatenate((k[agree], m[agree])), minlength=len(closures))


def loop_chi2(
    a: Trajectory, b: Trajectory, closures: Closures, k: NDArray[np.int64], m: NDArray[np.int64]
) -> FloatArray:
    """Squared Mahalanobis length (P,) of the loops: back over closure k, along a, over closure m, back along b."""
    i, j, T_i_j = closures.i, closures.j, closures.T_i_j
    along_a = se2.between(a.poses[i[k]], a.poses[i[m]])
    along_b = se2.between(b.poses[j[m]], b.poses[j[k]])
    over_b = se2.compose(T_i_j[m], along_b)
    residual = se2.log(se2.compose(se2.between(T_i_j[k], along_a), over_b))
    # First-order covariance in the tangent space at the loop's end, as if it closed.
    covariance = np.linalg.inv(closures.information).astype(np.float64)
    spread = covariance[k] + carried(covariance[m], along_b)
    spread += carried(a.drift(i[k], i[m]), over_b) + b.drift(j[m], j[k])
    chi2: FloatArray = np.einsum("pa,pa->p", residual, np.linalg.solve(spread, residual[..., None])[..., 0])
    return chi2


def _check(numbers: NDArray[np.int64], size: int, name: str) -> None:
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= size):
        raise ValueError(f"trajectory {name} has keyscans 0 to {size - 1}; a closure names another")
