"""Precision and recall of a run's closures by stage, against the optimized graph of reference relations.

The optimum of all relations gives relative poses of stamps that no single relation connects. The ends of a closure are
other poses, shortly before or after. The run's own trajectory bridges this gap; over such a short time it is as
accurate as odometry.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.graph.initialization import initialize_robust
from fcslam.graph.optimizer import optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lab.evaluation.closures import STAGES, ClosureScope, closure_rows, closure_sets
from fcslam.lab.evaluation.relations import pose_table
from fcslam.metrics.closures import (
    WITHIN_GAP_S,
    ClosureErrors,
    Mask,
    Precision,
    Recall,
    Rows,
    precision,
    revisits_found,
)
from fcslam.metrics.relations import ACROSS_ROBOTS_GAP_S, PoseTable, Relations, motion_errors, read_relations
from fcslam.records import ClosureStatus, FloatArray, frozen
from fcslam.runs import Run, open_run

BRIDGE_S: Final = 1.0
"""Largest time between an end of a closure and a reference pose that covers it."""
SIGMA_M, SIGMA_DEG = 0.05, 1.0
"""Assumed standard deviation of a manual relation, the same for all. It decides which relations contradict each other;
for consistent relations, it cancels out."""


@dataclass(frozen=True, slots=True)
class RelationGraph:
    """The optimized pose graph of a set of relations."""

    stamps: FloatArray
    """Stamps of all relations, ascending, shape (M,), seconds."""
    T_component_base: FloatArray
    """Optimized poses, shape (M, 3); each component has its own coordinate frame."""
    components: NDArray[np.int64]
    """Connected component of each stamp by inlier relations, shape (M,)."""
    relations: Relations
    """The relations of the graph; relations between equal stamps are dropped."""
    ends: NDArray[np.int64]
    """Numbers of the stamps that each relation connects, shape (R, 2)."""
    holds: NDArray[np.bool_]
    """Inliers of the robust optimization, shape (R,)."""
    residual_m: FloatArray
    """Translation residual of each relation, shape (R,); NaN across components."""
    residual_deg: FloatArray
    """Rotation residual of each relation, shape (R,); NaN across components."""

    @property
    def component_sizes(self) -> NDArray[np.int64]:
        """Number of stamps in each component, the largest first, shape (C,)."""
        return np.sort(np.unique(self.components, return_counts=True)[1])[::-1]

    def chain_lengths(self, pairs: NDArray[np.int64]) -> FloatArray:
        """Length of the shortest chain of relations between stamps with numbers (K, 2): shape (K,), inf without one."""
        joined = self.ends[self.holds]
        links = coo_array((np.ones(len(joined)), tuple(joined.T)), shape=(len(self.stamps), len(self.stamps)))
        sources, row = np.unique(pairs[:, 0], return_inverse=True)
        if not len(sources):
            return np.empty(0)
        lengths = shortest_path(links.tocsr(), directed=False, unweighted=True, indices=sources)
        return np.asarray(lengths[row, pairs[:, 1]])


def build_relation_graph(relations: Relations) -> RelationGraph:
    """Optimize ``relations``, any of which may be false, by graduated non-convexity."""
    useful = relations.where(relations.stamps[:, 0] != relations.stamps[:, 1])
    stamps, numbers = np.unique(useful.stamps, return_inverse=True)
    ends = numbers.reshape(-1, 2)
    information = np.diag([SIGMA_M**-2, SIGMA_M**-2, np.radians(SIGMA_DEG) ** -2])
    edges = [
        Edge(i, j, T_1_2, information, robust=True) for (i, j), T_1_2 in zip(ends.tolist(), useful.T_1_2, strict=True)
    ]
    graph = PoseGraph(np.zeros((len(stamps), 3)), edges)
    solution = optimize_gnc(graph, initialize_robust(graph))
    holds = solution.weights > 0.5
    components = graph.components(holds)
    first, second = ends.T
    residual = se2.between(useful.T_1_2, se2.between(solution.poses[first], solution.poses[second]))
    residual[components[first] != components[second]] = np.nan
    return RelationGraph(
        frozen(stamps),
        solution.poses,
        frozen(components, np.int64),
        useful,
        frozen(ends, np.int64),
        frozen(holds, np.bool_),
        frozen(np.hypot(residual[:, 0], residual[:, 1])),
        frozen(np.degrees(np.abs(residual[:, 2]))),
    )


class ReferenceMotion(NamedTuple):
    """A relative pose of a reference, near two poses of a run."""

    a: int
    """Row of the reference pose near the first pose."""
    b: int
    """Row of the reference pose near the second pose."""
    T_a_b: FloatArray
    """Shape (3,)."""


class Reference(Protocol):
    """A source of true relative poses between some of a run's poses."""

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """The relative pose whose ends are nearest in time to rows i and j; None if none is near enough."""


@dataclass(frozen=True, slots=True)
class PoseReference:
    """Reference poses in components; relative poses are only known within a component."""

    run: PoseTable
    bridge_s: float
    rows: Rows
    """Rows of the reference poses in the run, shape (M,)."""
    T_component_base: FloatArray
    """Reference poses in the frame of their component, shape (M, 3)."""
    components: NDArray[np.int64]
    """Component of each pose, shape (M,)."""

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """As in Reference."""
        a, b = self._near(i), self._near(j)
        stamps = self.run.stamps
        away_s = np.abs(stamps[self.rows[a]] - stamps[i])[:, None] + np.abs(stamps[self.rows[b]] - stamps[j])
        away_s[self.components[a][:, None] != self.components[b]] = np.inf
        if not np.isfinite(away_s).any():
            return None
        best_a, best_b = np.unravel_index(np.argmin(away_s), away_s.shape)
        first, second = a[best_a], b[best_b]
        T_a_b = se2.between(self.T_component_base[first], self.T_component_base[second])
        return ReferenceMotion(int(self.rows[first]), int(self.rows[second]), T_a_b)

    def _near(self, row: int) -> NDArray[np.int64]:
        """Reference poses of the same robot at most ``bridge_s`` away."""
        away_s, robots = np.abs(self.run.stamps[self.rows] - self.run.stamps[row]), self.run.robots
        return np.flatnonzero((away_s <= self.bridge_s) & (robots[self.rows] == robots[row]))


class RelationReference:
    """Single reference relations, in both directions, neither chained nor optimized."""

    def __init__(self, run: PoseTable, bridge_s: float, ends: Rows, T_1_2: FloatArray) -> None:
        """``ends``, shape (R, 2), are the rows that the relative poses ``T_1_2``, shape (R, 3), connect."""
        self._run, self._bridge_s = run, bridge_s
        self._ends = np.concatenate((ends, ends[:, ::-1]))
        self._T_a_b = np.concatenate((T_1_2, se2.inverse(T_1_2)))

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """As in Reference."""
        stamps, robots = self._run.stamps, self._run.robots
        away_s = np.abs(stamps[self._ends] - stamps[[i, j]])
        near = np.flatnonzero(np.all((away_s <= self._bridge_s) & (robots[self._ends] == robots[[i, j]]), axis=1))
        if not len(near):
            return None
        best = near[np.argmin(away_s[near].sum(axis=1))]
        a, b = self._ends[best]
        return ReferenceMotion(int(a), int(b), self._T_a_b[best])


@dataclass(frozen=True, slots=True)
class BridgedErrors(ClosureErrors):
    """Errors against reference poses near the ends."""

    ends: Rows
    """Rows of the reference poses that a closure was compared with, shape (K, 2); -1 without a reference."""


def closure_errors(pairs: Rows, T_i_j: FloatArray, run: PoseTable, reference: Reference) -> BridgedErrors:
    """Errors of closures ``T_i_j`` (K, 3), metres and radians, between rows ``pairs`` (K, 2) of ``run``."""
    ends = np.full((len(pairs), 2), -1, dtype=np.int64)
    true = np.full((len(pairs), 3), np.nan)
    for k, (i, j) in enumerate(pairs.tolist()):
        motion = reference.motion(i, j) if min(i, j) >= 0 else None
        if motion is not None:
            ends[k] = motion.a, motion.b
            T_i_a = se2.between(run.T_map_base[i], run.T_map_base[motion.a])
            T_b_j = se2.between(run.T_map_base[motion.b], run.T_map_base[j])
            true[k] = se2.compose(se2.compose(T_i_a, motion.T_a_b), T_b_j)
    return BridgedErrors(*motion_errors(true, T_i_j), frozen(ends, np.int64))


@dataclass(frozen=True, slots=True)
class ClosureScore:
    """Scores of one set of closures against the reference."""

    graph: Precision
    """Precision against the optimized graph of the relations."""
    single: Precision
    """Precision against single relations, those with the nearest stamps."""
    recall: Recall | None
    """None for discarded closures."""
    chain: tuple[float, float]
    """Median and maximum number of relations between the ends of a closure; NaN without any."""


@dataclass(frozen=True, slots=True)
class ClosureReport:
    """Scores of a run's closures against a relations file."""

    scores: Mapping[tuple[ClosureScope, ClosureStatus], ClosureScore]
    relations: RelationGraph
    stamps_in_run: int
    """Number of the relations' stamps at which the run has a pose."""


def evaluate_closures(run: Path, relations: Path) -> ClosureReport:
    """Precision and recall of the closures in the run folder ``run`` against the file ``relations``.

    Raises:
        InputError: one of them cannot be read, or no relation names a stamp of the run.
    """
    graph = build_relation_graph(read_relations(relations))
    opened = open_run(run)
    poses = pose_table(opened)
    node_rows = poses.find(graph.stamps)
    if not np.any(node_rows >= 0):
        raise InputError(f"{relations}: no relation names a stamp of {run}; are they of the same recording?")
    evidence = _gather(opened, poses, graph, node_rows)
    scores = {
        (within, status): evidence.score(members, within, status in STAGES)
        for (within, status), members in closure_sets(opened).items()
    }
    return ClosureReport(scores, graph, int(np.sum(node_rows >= 0)))


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Errors and chains of all closures."""

    poses: PoseTable
    pairs: Rows
    """Rows of the ends of the closures, shape (K, 2)."""
    by_graph: BridgedErrors
    by_one: ClosureErrors
    chains: FloatArray
    """Number of relations between the ends of each closure, shape (K,); NaN if they are not connected."""
    revisits: Rows
    """Revisits according to the relations, pairs of rows, shape (R, 2)."""

    def score(self, members: Mask, within: ClosureScope, is_stage: bool) -> ClosureScore:
        """Score the closures that ``members``, shape (K,), selects."""
        covered = self.chains[members & self.by_graph.covered]
        return ClosureScore(
            precision(self.by_graph, members),
            precision(self.by_one, members),
            self._recall(members, within) if is_stage else None,
            (_quantile(covered, 0.5), _quantile(covered, 1.0)),
        )

    def _recall(self, members: Mask, within: ClosureScope) -> Recall:
        first, second = self.poses.robots[self.revisits].T
        revisits = self.revisits[(first == second) == (within is ClosureScope.ROBOT)]
        correct = self.pairs[members & self.by_graph.correct]
        found = revisits_found(revisits, correct, self.poses)
        return Recall(len(revisits), int(found.sum()))


def _gather(run: Run, poses: PoseTable, graph: RelationGraph, node_rows: Rows) -> _Evidence:
    pairs = closure_rows(run, poses)
    T_i_j = np.array([closure.T_i_j for closure in run.closures]).reshape(-1, 3)
    ends = node_rows[graph.ends]
    usable = np.all(ends >= 0, axis=1) & graph.holds
    placed = _placed_reference(graph, node_rows, poses)
    single = RelationReference(poses, BRIDGE_S, ends[usable], graph.relations.T_1_2[usable])
    by_graph = closure_errors(pairs, T_i_j, poses, placed)
    return _Evidence(
        poses,
        pairs,
        by_graph,
        closure_errors(pairs, T_i_j, poses, single),
        _chains(graph, node_rows, by_graph),
        ends[usable & _is_revisit(ends, graph.relations.stamps, poses)],
    )


def _placed_reference(graph: RelationGraph, node_rows: Rows, poses: PoseTable) -> PoseReference:
    """The graph's poses at stamps of the run."""
    known = np.flatnonzero(node_rows >= 0)
    return PoseReference(poses, BRIDGE_S, node_rows[known], graph.T_component_base[known], graph.components[known])


def _is_revisit(ends: Rows, stamps: FloatArray, poses: PoseTable) -> Mask:
    """Whether a relation connects two visits, not two moments of one visit: shape (R,), for rows and stamps (R, 2)."""
    across = poses.robots[ends[:, 0]] != poses.robots[ends[:, 1]]
    least_s = np.where(across, ACROSS_ROBOTS_GAP_S, WITHIN_GAP_S)
    longer: Mask = np.abs(stamps[:, 1] - stamps[:, 0]) > least_s
    return longer


def _chains(graph: RelationGraph, node_rows: Rows, errors: BridgedErrors) -> FloatArray:
    """Number of relations between the ends of each closure, shape (K,); NaN if the graph does not cover it."""
    number_of = {row: number for number, row in enumerate(node_rows.tolist()) if row >= 0}
    covered = errors.covered
    pairs = np.array([(number_of[a], number_of[b]) for a, b in errors.ends[covered].tolist()], dtype=np.int64)
    chains = np.full(len(covered), np.nan)
    chains[covered] = graph.chain_lengths(pairs.reshape(-1, 2))
    return chains


def _quantile(values: FloatArray, share: float) -> float:
    """Quantile of the finite ``values`` (K,); NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else np.nan
