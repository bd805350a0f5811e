"""When is the agreement of closures enough to say how two robots' maps lie to each other? The dominant cluster."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.geometry import se2
from fcslam.geometry.alignment import two_point_alignment
from fcslam.graph.clique import maximum_clique
from fcslam.graph.consistency import Closures, ConsistencySettings, pairwise_consistency
from fcslam.graph.trajectory import Trajectory
from fcslam.records import FloatArray

DIRECTION_M = 1.0
"""Two points as far apart as this, each known to a few centimetres, give a direction."""

_APART_BUDGET = 500
"""Branches looked at for the largest set of places that lie apart; a set that is not proven is a lower bound."""


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


def judge(
    a: Trajectory, b: Trajectory, closures: Closures, informative: ArrayLike, settings: ConsistencySettings
) -> ClusterVerdict:
    """The verdict on the closures between two robots; ``informative`` as in :func:`dominant_cluster`."""
    consistent = pairwise_consistency(a, b, closures, settings)
    return dominant_cluster(consistent, places_of(a, b, closures), informative, settings)


def places_of(a: Trajectory, b: Trajectory, closures: Closures) -> FloatArray:
    """Where both ends of each closure lie, (K, 2, 2), metres, each in its own trajectory's frame."""
    return np.stack((a.poses[closures.i, :2], b.poses[closures.j, :2]), axis=1)


def relative_frame(a: Trajectory, b: Trajectory, closures: Closures) -> FloatArray:
    """T_a_b of two trajectories' frames from the two matched places that lie farthest apart, eqs. (5)-(6).

    Places too near to each other to tell a direction leave it to the first closure alone.
    """
    T_a_j = se2.compose(a.poses[closures.i], closures.T_i_j)
    in_a, in_b = T_a_j[:, :2], b.poses[closures.j, :2]
    distance = np.hypot(*np.moveaxis(in_b[:, None] - in_b[None], -1, 0))
    k, m = np.unravel_index(int(np.argmax(distance)), distance.shape)
    if distance[k, m] < DIRECTION_M:
        return se2.compose(T_a_j[0], se2.inverse(b.poses[closures.j[0]]))
    return two_point_alignment(in_a[[k, m]], in_b[[k, m]])


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
    supporters, rivals = apart(xy[members], settings.separation_m), apart(xy[runner_up], settings.separation_m)
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


def apart(places: FloatArray, separation_m: float) -> int:
    """How many of the places (K, S, 2) lie ``separation_m`` or more from one another, on every side.

    One place of b that looks like three of a is one witness, not three.
    """
    gaps = np.hypot(*np.moveaxis(places[:, None] - places[None], -1, 0)).min(axis=-1, initial=np.inf)
    return len(maximum_clique(gaps >= separation_m, _APART_BUDGET).members)
