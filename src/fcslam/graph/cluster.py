"""The dominant cluster: when consistent closures are enough to fix the transform between the maps of two robots.

The largest cluster is a maximum clique, by exact branch and bound with a greedy colouring bound (Tomita and Kameda
2007, MCR): a clique takes at most one vertex of each colour class, so a branch with too few colours to beat the best
clique is pruned. Vertices are ordered by falling degree, then by number: the result is deterministic. Sets are the bits
of one integer.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.geometry.alignment import ROUNDING
from fcslam.geometry.groups import SE2, group_of
from fcslam.graph.consistency import Closures, pairwise_consistency
from fcslam.graph.evidence import (
    CLEAR_LIKENESS,
    LEAD,
    ClusterEvidence,
    ConsistencySettings,
    MapFit,
    refutation,
    shortfall,
)
from fcslam.graph.trajectory import Trajectory
from fcslam.records import FloatArray, Reason, ReasonCode

NODE_BUDGET = 50_000
"""Largest number of branches; after them the best clique so far is returned as not proven ..."""

VERTEX_BUDGET = 80 * NODE_BUDGET
"""... and of branches times vertices: a branch of a large graph takes longer."""
MayDecide = Callable[[MapFit], bool]
"""Whether a fit decides, unless the maps fit elsewhere as well: if not, nobody needs to look for such transforms."""

Examine = Callable[[NDArray[np.int64], MayDecide], MapFit | None]
"""Compares the maps at the transform of some closures, given by their rows, shape (M,), and, where that may decide,
elsewhere; None: the maps cannot be compared, and only separate places count."""

_NO_LEAD = ReasonCode.NO_LEAD, ReasonCode.RIVAL_PLACES
_MAPS_DECIDE = ReasonCode.NOT_INFORMATIVE, ReasonCode.FEW_PLACES, *_NO_LEAD
"""Reasons that a comparison of the maps may refute."""
_MAPS_REFUTE = ReasonCode.MAPS_CONTRADICT, ReasonCode.WALLS_DIFFER, ReasonCode.LOOK_ALIKE
"""Reasons of that comparison against a cluster; a smaller one that contradicts it may be right."""
MOST_CLUSTERS = 8
"""Most clusters that are compared with the maps: a building that repeats itself has more."""

DIRECTION_M = 1.0
"""Least distance between two matched points that fixes a rotation: each point is known to a few centimetres."""

FARTHEST_M = 20.0
"""A closure gives the transform between two maps up to this far along the path: beyond, drift counts."""

_SEPARATE_BUDGET = NODE_BUDGET // 100
"""Branches searched for the largest set of separate places; beyond them the result is a lower bound."""
_MEAN_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class ClusterDecision:
    """Whether one cluster of closures is dominant."""

    members: tuple[int, ...]
    """Largest cluster of pairwise consistent closures, or a smaller one if only there the maps agree."""
    evidence: ClusterEvidence
    """Its rivals are the largest cluster whose closures are inconsistent with at least half of the members each."""
    contested: bool
    """Whether the rivals would be enough to join two maps as well and the cluster is not clearly larger, or the maps
    refute the largest cluster."""
    shortfall: Reason | None
    """Why the cluster is not dominant; a setting is one of ``ConsistencySettings``."""

    @property
    def dominant(self) -> bool:
        """Whether the cluster is enough to join two maps."""
        return self.shortfall is None


def decide_cluster(
    a: Trajectory,
    b: Trajectory,
    closures: Closures,
    informative: ArrayLike,
    settings: ConsistencySettings,
    examine: Examine = lambda *_: None,
) -> ClusterDecision:
    """Decide if K closures from a to b have a dominant cluster; ``informative`` (K,): which fix every direction."""
    consistent = pairwise_consistency(a, b, closures)
    positions = closure_positions(a, b, closures)
    return dominant_cluster(
        consistent, positions, informative, settings, examine, lambda m: closures.select(m).shared_tags()
    )


def closure_positions(a: Trajectory, b: Trajectory, closures: Closures) -> FloatArray:
    """Positions of both ends of K closures, shape (K, 2, 2), metres; row 0 in the frame of a, row 1 in that of b.

    Closures by one tag are one place, from wherever it is seen: all have the position of the first of them.
    """
    first = np.arange(len(closures))
    for tag in np.unique(closures.tags[closures.tags > 0]):
        rows = np.flatnonzero(closures.tags == tag)
        first[rows] = rows[0]
    return np.stack((a.poses[closures.i[first], :2], b.poses[closures.j[first], :2]), axis=1)


def relative_frame(a: Trajectory, b: Trajectory, closures: Closures) -> FloatArray:
    """Estimate ``T_a_b`` (P,) of the frames of two trajectories from the two matched places that lie farthest apart.

    Implements eqs. (5)-(6) of FC-SLAM in the plane. If these places are too close to each other in a or b to fix a
    rotation, the first closure alone gives the transform. Tags fix the heading worse than walls, so they count only
    without others, and then all of them by their information. In space, two points fix no rotation: all count.
    """
    group = group_of(closures.T_i_j)
    if group is not SE2:
        return _mean_frame(a, b, closures)
    if (closures.tags > 0).any():
        walls = np.flatnonzero(closures.tags == 0)
        if not len(walls):
            return _mean_frame(a, b, closures)
        closures = closures.select(walls)
    T_a_j = group.compose(a.poses[closures.i], closures.T_i_j)
    in_a, in_b = T_a_j[:, :2], b.poses[closures.j, :2]
    distance = np.hypot(*np.moveaxis(in_b[:, None] - in_b[None], -1, 0))
    k, m = np.unravel_index(int(np.argmax(distance)), distance.shape)
    if min(distance[k, m], np.hypot(*(in_a[k] - in_a[m]))) < DIRECTION_M:
        return group.compose(T_a_j[0], group.inverse(b.poses[closures.j[0]]))
    return two_point_alignment(in_a[[k, m]], in_b[[k, m]])


def rotation_eq5(alpha_rad: float) -> FloatArray:
    """Homogeneous rotation matrix of the paper, shape (3, 3); with its signs it rotates by ``-alpha_rad``."""
    cos, sin = np.cos(alpha_rad), np.sin(alpha_rad)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])  # eq. (5)


def two_point_alignment(points_a: ArrayLike, points_b: ArrayLike) -> FloatArray:
    """Compute ``T_a_b`` from two matched points by eqs. (5) and (6) of FC-SLAM in their corrected form.

    The paper prints eq. (6) as ``x' = -D R D x``, with the translation D on both sides of R. This is not a rigid map
    between two frames. Its homogeneous coordinate is -1, and with it divided out the translation counts twice. The
    corrected form is ``x' = D R x``.

    Args:
        points_a: shape (2, 2), metres, in the coordinate frame a (the paper's x').
        points_b: the same points in the coordinate frame b (the paper's x); the midpoints coincide.

    Returns:
        ``T_a_b``, shape (3,), metres and radians.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if _coincide(a) or _coincide(b):
        raise ValueError("two coincident points determine no rotation")
    side_a, side_b = a[1] - a[0], b[1] - b[0]
    alpha = np.arctan2(side_b[1], side_b[0]) - np.arctan2(side_a[1], side_a[0])
    R = rotation_eq5(alpha)[:2, :2]
    # eq. (6), corrected: x' = R x + (dx, dy)
    dx, dy = a.mean(axis=0) - R @ b.mean(axis=0)
    return np.array([dx, dy, np.arctan2(R[1, 0], R[0, 0])])


def _coincide(points: FloatArray) -> bool:
    side = points[1] - points[0]
    return bool(side @ side <= ROUNDING * (points * points).sum())


def local_frames(a: Trajectory, b: Trajectory, members: Closures) -> FloatArray:
    """T_a_b (N, P) at each of the N keyscans of b by the closure that is nearest along b's path, without drift.

    NaN farther than ``FARTHEST_M`` of path from any closure. Tags fix the heading worse than walls, so they count only
    without other closures, and then all together.
    """
    walls = np.flatnonzero(members.tags == 0) if len(members.tags) else np.arange(len(members))
    if not len(walls):
        return np.broadcast_to(relative_frame(a, b, members), b.poses.shape)
    members, group = members.select(walls), group_of(b.poses)
    distance_m = np.abs(b.travel_m[:, None] - b.travel_m[members.j][None])
    nearest = np.argmin(distance_m, axis=1)
    T_a_b = group.compose(group.compose(a.poses[members.i], members.T_i_j), group.inverse(b.poses[members.j]))
    T: FloatArray = T_a_b[nearest]
    T[distance_m.min(axis=1) > FARTHEST_M] = np.nan
    return T


def _mean_frame(a: Trajectory, b: Trajectory, closures: Closures) -> FloatArray:
    """``T_a_b`` (P,) by least squares over all closures, from the most precise one."""
    group = group_of(closures.T_i_j)
    T_i_a, T_b_j = group.inverse(a.poses[closures.i]), b.poses[closures.j]
    best = int(np.argmax(np.linalg.det(closures.information)))
    T_a_b = group.compose(group.inverse(T_i_a[best]), group.compose(closures.T_i_j[best], group.inverse(T_b_j[best])))
    moved = group.adjoint(group.inverse(T_b_j))
    weighted = moved.swapaxes(-1, -2) @ closures.information
    for _ in range(_MEAN_ROUNDS):
        residuals = group.log(group.between(closures.T_i_j, group.compose(group.compose(T_i_a, T_a_b), T_b_j)))
        step = np.linalg.solve((weighted @ moved).sum(axis=0), -np.einsum("kab,kb->a", weighted, residuals))
        T_a_b = group.retract(T_a_b, step)
    return T_a_b


def dominant_cluster(
    consistent: NDArray[np.bool_],
    places: ArrayLike,
    informative: ArrayLike,
    settings: ConsistencySettings,
    examine: Examine = lambda *_: None,
    shared_tags: Callable[[NDArray[np.int64]], int] = lambda _: 0,
) -> ClusterDecision:
    """Find the largest consistent cluster and decide whether it is enough to join two maps.

    False closures from repeated structure are consistent with one another, too. So the cluster must have:

    - an informative member, or maps that fit in one way only;
    - maps that agree at its transform, and there clearly better than at any other (``fcslam.graph.evidence``). If they
      do not, the next largest clusters that contradict it are tried;
    - without a comparison of the maps, a clear lead over the cluster that contradicts it: ``lead`` times as many
      closures, and no fewer places;
    - enough evidence: members from separate places, or a unique alignment of the maps.

    Args:
        consistent: which pairs of closures are consistent, shape (K, K), from ``pairwise_consistency``.
        places: positions of the closures in metres, shape (K, 2), or (K, S, 2) as seen by S trajectories, each side in
            one coordinate frame.
        informative: whether each closure fixes the pose in every direction, shape (K,).
        settings: what a cluster needs.
        examine: called with the members of a cluster that has enough closures, and of the one that contradicts it.
        shared_tags: counts the tags among some rows, shape (M,), that both robots saw from several keyscans.

    Returns:
        The decision; its members are rows of ``consistent``.
    """
    xy, informs = np.asarray(places, dtype=np.float64), np.asarray(informative, dtype=bool)
    xy = xy.reshape(len(xy), xy.size // (2 * max(1, len(xy))), 2)

    def decide(rows: NDArray[np.int64], rivals: NDArray[np.int64]) -> tuple[ClusterEvidence, Reason | None]:
        evidence = replace(
            evidence_of(xy[rows], informs[rows], shared_tags(rows), settings.separation_m),
            rival_closures=len(rivals),
            rival_places=count_separate_places(xy[rivals], settings.separation_m),
        )
        by_count = shortfall(evidence, settings)
        if by_count is not None and by_count.code not in _MAPS_DECIDE:
            return evidence, by_count

        def may_decide(fit: MapFit) -> bool:
            unopposed = replace(evidence, fit=fit, rival_closures=0, rival_places=0)
            # If the maps refute this cluster, that of the rivals may be right.
            return len(rivals) >= settings.minimum_closures or shortfall(unopposed, settings) is None

        fit = examine(rows, may_decide)
        lead = evidence.closures - LEAD * evidence.rival_closures
        if fit is not None and (lead < 0.0 or evidence.separate_places < evidence.rival_places):
            rival = examine(rivals, lambda _: True)
            if rival is None:
                return evidence, by_count
            if not rival.is_compared or refutation(rival) is None:
                fit = replace(fit, rival_support=max(fit.rival_support, rival.support))
            elif fit.is_compared and fit.likeness >= CLEAR_LIKENESS and rival.support < 0.0:
                # The walls decide: those of the rival say that it is another place.
                evidence = replace(evidence, rival_closures=0, rival_places=0)
        evidence = replace(evidence, fit=fit)
        return evidence, shortfall(evidence, settings)

    remaining, refuted = np.arange(len(consistent)), list[ClusterDecision]()
    for _ in range(MOST_CLUSTERS):
        largest, _ = maximum_clique(consistent[np.ix_(remaining, remaining)])
        members = remaining[largest]
        others = np.flatnonzero(2 * consistent[:, members].sum(axis=1) <= len(members))
        others = np.setdiff1d(others, members)
        second, _ = maximum_clique(consistent[np.ix_(others, others)])
        evidence, reason = decide(members, others[second])
        is_refuted = reason is not None and reason.code in _MAPS_REFUTE
        has_no_lead = reason is not None and reason.code in _NO_LEAD
        decision = ClusterDecision(
            members=tuple(members.tolist()),
            evidence=evidence,
            contested=is_refuted or (has_no_lead and evidence.rival_places >= settings.minimum_evidence),
            shortfall=reason,
        )
        remaining = np.intersect1d(remaining, others)
        if not is_refuted:
            if not refuted:
                return decision
            return replace(decision, contested=True) if reason is None else refuted[0]
        refuted.append(decision)
        if not len(remaining):
            break
    return refuted[0]


def evidence_of(places: FloatArray, informative: NDArray[np.bool_], tags: int, separation_m: float) -> ClusterEvidence:
    """The evidence of K closures that agree, without rivals: ``places`` (K, S, 2) in metres, ``informative`` (K,)."""
    places_apart = count_separate_places(places, separation_m)
    return ClusterEvidence(len(places), int(np.count_nonzero(informative)), places_apart, tags=tags)


def count_separate_places(places: FloatArray, separation_m: float) -> int:
    """Count the places (K, S, 2), as seen by S trajectories, that lie ``separation_m`` from one another on every side.

    A place of b that looks like three places of a counts once.
    """
    gaps = np.hypot(*np.moveaxis(places[:, None] - places[None], -1, 0)).min(axis=-1, initial=np.inf)
    return len(maximum_clique(gaps >= separation_m, _SEPARATE_BUDGET)[0])


def maximum_clique(adjacent: NDArray[np.bool_], node_budget: int = NODE_BUDGET) -> tuple[list[int], bool]:
    """Find the largest clique of a graph.

    Args:
        adjacent: adjacency matrix, shape (K, K), symmetric; the diagonal does not count.
        node_budget: largest number of branches.

    Returns:
        The vertices of the largest clique in ascending order, and whether that is proven; if the budget ran out, the
        largest one found, at least the greedy one.
    """
    matrix = np.asarray(adjacent, dtype=bool)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or (matrix != matrix.T).any():
        raise ValueError(f"an adjacency matrix is square and symmetric; this one has shape {matrix.shape}")
    size = len(matrix)
    if size == 0:
        return [], True
    matrix = matrix & ~np.eye(size, dtype=bool)
    order = np.argsort(-matrix.sum(axis=1), kind="stable")
    rows = np.packbits(matrix[np.ix_(order, order)], axis=1, bitorder="little")
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in rows]
    best, exact = _search(neighbours, min(node_budget, VERTEX_BUDGET // size))
    return sorted(int(order[vertex]) for vertex in _bits(best)), exact


def _search(neighbours: list[int], node_budget: int) -> tuple[int, bool]:
    """Largest clique as bits, and whether it is proven. An explicit stack: large cliques exceed Python's recursion."""
    best, best_size, nodes = 0, 0, 0
    everything = (1 << len(neighbours)) - 1
    stack: list[tuple[int, int, list[tuple[int, int]]]] = [(0, everything, _coloured(everything, neighbours))]
    while stack:
        clique, candidates, branches = stack.pop()
        if not branches or clique.bit_count() + branches[-1][1] <= best_size:
            continue
        nodes += 1
        if nodes > node_budget + len(neighbours):
            return best, False
        vertex, _ = branches.pop()
        stack.append((clique, candidates & ~(1 << vertex), branches))
        grown, left = clique | (1 << vertex), candidates & neighbours[vertex]
        if grown.bit_count() > best_size:
            best, best_size = grown, grown.bit_count()
        if left:
            stack.append((grown, left, _coloured(left, neighbours)))
    return best, True


def _coloured(vertices: int, neighbours: list[int]) -> list[tuple[int, int]]:
    """(vertex, colours used so far), ascending: no clique among the vertices so far has more members than colours."""
    result: list[tuple[int, int]] = []
    colour = 0
    while vertices:
        colour += 1
        free = vertices
        while free:
            vertex = (free & -free).bit_length() - 1
            result.append((vertex, colour))
            vertices &= ~(1 << vertex)
            free &= ~(neighbours[vertex] | (1 << vertex))
    return result


def _bits(vertices: int) -> Iterator[int]:
    while vertices:
        yield (vertices & -vertices).bit_length() - 1
        vertices &= vertices - 1
