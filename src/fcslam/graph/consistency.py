"""Pairwise consistency of closures between two trajectories (PCM, Mangelson et al., ICRA 2018), and the verdict.

Two closures agree if the loop they form with the two stretches of trajectory between them closes, within their own
covariances and the drift of both stretches. Which frame the trajectories have to each other plays no part.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.special import gammaincinv

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.graph.clique import maximum_clique
from fcslam.records import FloatArray

_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


class ConsistencySettings(Settings):
    """When closures between two trajectories agree, and when their agreement is enough to join two maps."""

    probability: float = Field(
        default=0.99, gt=0.0, lt=1.0, description="Two true closures pass the chi-square test with this probability"
    )
    position_drift_m: float = Field(
        default=0.02, gt=0.0, description="Standard deviation of a trajectory's position after one metre"
    )
    heading_drift_rad: float = Field(
        default=0.005, gt=0.0, description="Standard deviation of a trajectory's heading after one metre"
    )
    minimum_closures: int = Field(default=3, ge=1, description="Supporters needed, from places that lie apart")
    separation_m: float = Field(default=3.0, ge=0.0, description="Distance from which two places lie apart")
    lead: float = Field(default=2.0, ge=1.0, description="Size needed, as a multiple of the second largest cluster")


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


@dataclass(frozen=True, slots=True)
class ClusterVerdict:
    """Whether one group of closures is dominant."""

    members: tuple[int, ...]
    """Largest cluster of pairwise consistent closures."""
    runner_up: tuple[int, ...]
    """Largest cluster that contradicts it: of closures that disagree with at least half of its members."""
    supporters: int
    """Members from places that lie apart."""
    runner_up_supporters: int
    exact: bool
    """Whether both clusters are proven to be the largest."""
    dominant: bool
    contested: bool
    """Whether a cluster that would be enough to join two maps, too, contradicts it and is not clearly smaller."""
    reason: str
    """One clause; empty if dominant."""


def pairwise_chi2(
    trajectory_a: ArrayLike, trajectory_b: ArrayLike, closures: Closures, settings: ConsistencySettings
) -> FloatArray:
    """Squared Mahalanobis length of the loop that each two closures form, (K, K), symmetric, 0 on the diagonal.

    The trajectories (N_a, 3), (N_b, 3) are every keyscan's pose, each in its own frame.

    Raises:
        ValueError: a closure names a keyscan that its trajectory does not have.
    """
    a, b = np.asarray(trajectory_a, dtype=np.float64), np.asarray(trajectory_b, dtype=np.float64)
    count = len(closures.i)
    _check(closures.i, len(a), "a")
    _check(closures.j, len(b), "b")
    k, m = np.triu_indices(count, 1)
    # The loop: back over closure k, along a, over closure m, back along b.
    along_a = se2.between(a[closures.i[k]], a[closures.i[m]])
    along_b = se2.between(b[closures.j[m]], b[closures.j[k]])
    over_b = se2.compose(closures.T_i_j[m], along_b)
    residual = se2.log(se2.compose(se2.between(closures.T_i_j[k], along_a), over_b))
    # First-order covariance in the tangent space at the loop's end, as if it closed.
    covariance = np.linalg.inv(closures.information).astype(np.float64)
    spread = covariance[k] + _carried(covariance[m], along_b)
    spread += _carried(_drift(a, closures.i[k], closures.i[m], settings), over_b)
    spread += _drift(b, closures.j[m], closures.j[k], settings)
    chi2 = np.zeros((count, count))
    chi2[k, m] = np.einsum("pa,pa->p", residual, np.linalg.solve(spread, residual[..., None])[..., 0])
    return chi2 + chi2.T


def pairwise_consistency(
    trajectory_a: ArrayLike, trajectory_b: ArrayLike, closures: Closures, settings: ConsistencySettings
) -> NDArray[np.bool_]:
    """Which closures agree, (K, K), symmetric, true on the diagonal; arguments as in :func:`pairwise_chi2`."""
    limit = 2.0 * gammaincinv(1.5, settings.probability)  # chi-square quantile, 3 degrees of freedom
    agree: NDArray[np.bool_] = pairwise_chi2(trajectory_a, trajectory_b, closures, settings) <= limit
    return agree


def dominant_cluster(
    consistent: NDArray[np.bool_], places: ArrayLike, informative: ArrayLike, settings: ConsistencySettings
) -> ClusterVerdict:
    """The largest consistent cluster, and whether it is enough to join two maps.

    ``consistent`` (K, K) from :func:`pairwise_consistency`; ``places`` (K, 2), or (K, S, 2) as seen by S
    trajectories, where each closure is (metres, each side in one frame); ``informative`` (K,) whether it fixes the
    pose in every direction. Aliases agree with one another, too: so the cluster must have enough supporters from
    different places, an informative one, and a clear lead over the largest one that contradicts it: in closures, and
    no less in places.
    """
    xy, informs = np.asarray(places, dtype=np.float64), np.asarray(informative, dtype=bool)
    xy = xy.reshape(len(xy), xy.size // (2 * max(1, len(xy))), 2)
    first = maximum_clique(consistent)
    members = list(first.members)
    others = np.flatnonzero(2 * consistent[:, members].sum(axis=1) <= len(members))
    others = np.setdiff1d(others, members)
    second = maximum_clique(consistent[np.ix_(others, others)])
    runner_up = others[list(second.members)]
    supporters, rivals = _apart(xy[members], settings.separation_m), _apart(xy[runner_up], settings.separation_m)
    behind = len(members) < settings.lead * len(runner_up) or supporters < rivals
    reason = ""
    if supporters < settings.minimum_closures:
        reason = f"{supporters} supporters {settings.separation_m:g} m apart, {settings.minimum_closures} needed"
    elif not informs[members].any():
        reason = "no supporter with information in every direction"
    elif behind:
        reason = f"{len(members)} closures from {supporters} places, but {len(runner_up)} from {rivals} disagree"
    return ClusterVerdict(
        members=first.members,
        runner_up=tuple(runner_up.tolist()),
        supporters=supporters,
        runner_up_supporters=rivals,
        exact=first.exact and second.exact,
        dominant=not reason,
        contested=behind and rivals >= settings.minimum_closures,
        reason=reason,
    )


def _drift(
    trajectory: FloatArray, start: NDArray[np.int64], end: NDArray[np.int64], settings: ConsistencySettings
) -> FloatArray:
    """Covariance (P, 3, 3) of the motion from ``start`` to ``end``, in the tangent space at its end.

    A random walk per metre: each piece of path adds to the position, and turns what comes after it about itself.
    """
    xy = trajectory[:, :2]
    middle = 0.5 * (xy[1:] + xy[:-1])
    length = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    metres = _between_sums(length, low, high)
    first = _between_sums(length[:, None] * middle, low, high)
    second = _between_sums(length[:, None, None] * middle[:, :, None] * middle[:, None, :], low, high)
    p = xy[end]
    cross = p[:, :, None] * first[:, None, :]
    # Sums over the pieces of path of the lever from the piece to the end, and of its square.
    lever = metres[:, None] * p - first
    lever_square = metres[:, None, None] * p[:, :, None] * p[:, None, :] - cross - cross.transpose(0, 2, 1) + second
    turn, walk = settings.heading_drift_rad**2, settings.position_drift_m**2
    covariance = np.empty((len(p), 3, 3))
    covariance[:, :2, :2] = turn * _QUARTER_TURN @ lever_square @ _QUARTER_TURN.T
    covariance[:, :2, :2] += walk * metres[:, None, None] * np.eye(2)
    covariance[:, :2, 2] = covariance[:, 2, :2] = turn * lever @ _QUARTER_TURN.T
    covariance[:, 2, 2] = turn * metres
    to_end = se2.inverse(trajectory[end])
    to_end[:, :2] = 0.0
    return _rotated(covariance, to_end)


def _rotated(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    adjoint = se2.adjoint(rotation)
    rotated: FloatArray = adjoint @ covariance @ adjoint.swapaxes(-1, -2)
    return rotated


def _carried(covariance: FloatArray, T: FloatArray) -> FloatArray:
    """Covariance at the tangent space before the motion ``T``, in the one after it."""
    return _rotated(covariance, se2.inverse(T))


def _between_sums(values: FloatArray, low: NDArray[np.int64], high: NDArray[np.int64]) -> FloatArray:
    """Sum of ``values[low:high]`` for each pair, along the first axis."""
    sums = np.concatenate((np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)))
    difference: FloatArray = sums[high] - sums[low]
    return difference


def _apart(xy: FloatArray, separation_m: float) -> int:
    """How many of the places (K, S, 2), taken in order, lie ``separation_m`` or more from all before, on every side.

    One place of b that looks like three of a is one witness, not three.
    """
    taken: list[FloatArray] = []
    for point in xy:
        if all(np.hypot(*(point - other).T).min() >= separation_m for other in taken):
            taken.append(point)
    return len(taken)


def _check(numbers: NDArray[np.int64], size: int, name: str) -> None:
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= size):
        raise ValueError(f"trajectory {name} has keyscans 0 to {size - 1}; a closure names another")
