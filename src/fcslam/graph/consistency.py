"""Pairwise consistency of closures between two trajectories (PCM, Mangelson et al., ICRA 2018).

Two closures are consistent if the loop that they form with the two stretches of trajectory between them closes, within
the covariances of the closures and the drift of both stretches. The transform between the two frames plays no part.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry.groups import group_of
from fcslam.graph.trajectory import Trajectory, transport_covariance
from fcslam.records import FloatArray

_PAIRS_AT_ONCE = 100_000
"""Pairs of closures tested in one go: memory must not grow with the square of the number of closures."""
SUPPORT_M = 10.0
"""Largest path, metres, between the ends of two closures on both trajectories at which they support each other."""
TAG_VIEWS = 2
"""Keyscans of each trajectory from which a tag must be seen to be evidence: a tag misread once is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Closures:
    """Closures between keyscans of a trajectory a and a trajectory b, one row each."""

    i: NDArray[np.int64]
    """Keyscan of a, shape (K,)."""
    j: NDArray[np.int64]
    """Keyscan of b, shape (K,)."""
    T_i_j: FloatArray
    """Pose of keyscan j in keyscan i, shape (K, P)."""
    information: FloatArray
    """Information of T_i_j in the tangent space at T_i_j, shape (K, d, d)."""
    tags: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    """Number from 1 of the tag that both keyscans saw, 0 without one, shape (K,); empty: no closure has one."""

    def __len__(self) -> int:
        return len(self.i)

    def reversed(self, rows: NDArray[np.bool_]) -> "Closures":
        """The same closures; those where ``rows``, shape (K,), is true lead from j to i."""
        # The tangent space moves from j to i: v_i = -Ad(T_i_j) v_j.
        group = group_of(self.T_i_j)
        back = np.linalg.inv(group.adjoint(self.T_i_j[rows]))
        i, j = np.where(rows, self.j, self.i), np.where(rows, self.i, self.j)
        T_i_j, information = self.T_i_j.copy(), self.information.copy()
        T_i_j[rows] = group.inverse(self.T_i_j[rows])
        information[rows] = back.swapaxes(-1, -2) @ self.information[rows] @ back
        return Closures(i, j, T_i_j, information, self.tags)

    def select(self, rows: NDArray[np.int64]) -> "Closures":
        """The closures with the indices ``rows``, shape (S,)."""
        tags = self.tags[rows] if len(self.tags) else self.tags
        return Closures(self.i[rows], self.j[rows], self.T_i_j[rows], self.information[rows], tags)

    def shared_tags(self) -> int:
        """Count the tags that both trajectories saw from several keyscans each."""
        rows = (self.tags == tag for tag in np.unique(self.tags[self.tags > 0]))
        views = (min(len(np.unique(end[seen])) for end in (self.i, self.j)) for seen in rows)
        return sum(count >= TAG_VIEWS for count in views)


def pairwise_consistency(a: Trajectory, b: Trajectory, closures: Closures) -> NDArray[np.bool_]:
    """Which pairs of K closures between two trajectories are consistent, shape (K, K), symmetric."""
    _check(closures.i, len(a), "a")
    _check(closures.j, len(b), "b")
    limit = group_of(closures.T_i_j).chi2_limit
    k, m = np.triu_indices(len(closures), 1)
    consistent = np.eye(len(closures), dtype=bool)
    for part in np.array_split(np.arange(len(k)), len(k) // _PAIRS_AT_ONCE + 1):
        consistent[k[part], m[part]] = loop_chi2(a, b, closures, k[part], m[part]) <= limit
    return consistent | consistent.T


def count_supporting_closures(a: Trajectory, b: Trajectory, closures: Closures) -> NDArray[np.int64]:
    """Count the closures that support each of K closures, shape (K,); ``a`` is ``b`` for closures within one robot.

    Two closures support each other if they are consistent and their ends are near each other along both paths, where
    drift can hardly explain the agreement. Robots that visit the same place close several loops there; a false closure
    is usually isolated.
    """
    if a is b:
        closures = closures.reversed(closures.i > closures.j)
    near = np.ones((len(closures), len(closures)), dtype=bool)
    for path, end in ((a, closures.i), (b, closures.j)):
        travel_m = path.travel_m[end]
        near &= np.abs(travel_m[:, None] - travel_m[None]) <= SUPPORT_M
    k, m = np.nonzero(np.triu(near, 1))
    consistent = loop_chi2(a, b, closures, k, m) <= group_of(closures.T_i_j).chi2_limit
    return np.bincount(np.concatenate((k[consistent], m[consistent])), minlength=len(closures))


def loop_chi2(
    a: Trajectory, b: Trajectory, closures: Closures, k: NDArray[np.int64], m: NDArray[np.int64]
) -> FloatArray:
    """Squared Mahalanobis length (P,) of loops: back over closure k, along a, over closure m, back along b.

    ``k`` and ``m`` are the rows of the two closures of each loop. The result has as many degrees of freedom as a pose.
    """
    i, j, T_i_j, group = closures.i, closures.j, closures.T_i_j, group_of(closures.T_i_j)
    along_a = group.between(a.poses[i[k]], a.poses[i[m]])
    along_b = group.between(b.poses[j[m]], b.poses[j[k]])
    over_b = group.compose(T_i_j[m], along_b)
    residual = group.log(group.compose(group.between(T_i_j[k], along_a), over_b))
    # First-order covariance in the tangent space at the loop's end, as if it closed.
    covariance = np.linalg.inv(closures.information).astype(np.float64)
    spread = covariance[k] + transport_covariance(covariance[m], along_b)
    spread += transport_covariance(a.drift(i[k], i[m]), over_b) + b.drift(j[m], j[k])
    chi2: FloatArray = np.einsum("pa,pa->p", residual, np.linalg.solve(spread, residual[..., None])[..., 0])
    return chi2


def _check(numbers: NDArray[np.int64], size: int, name: str) -> None:
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= size):
        raise ValueError(f"trajectory {name} has keyscans 0 to {size - 1}; a closure names another")
