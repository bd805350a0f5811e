"""Precision and recall of a run's closures by stage, against the optimised graph of reference relations."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from fcslam.errors import EvaluationError
from fcslam.lab.evaluation.fleet.relation_graph import RelationGraph, build_relation_graph
from fcslam.lab.evaluation.fleet.relations import pose_table
from fcslam.metrics.closures import (
    BRIDGE_S,
    WITHIN_GAP_S,
    ClosureErrors,
    Mask,
    PoseReference,
    Precision,
    Recall,
    RelationReference,
    Rows,
    closure_errors,
    precision,
    revisits_found,
)
from fcslam.metrics.relations import ACROSS_ROBOTS_GAP_S, PoseTable, read_relations
from fcslam.records import ClosureStatus, FloatArray
from fcslam.runs import Metric, Run, open_run

STAGES: Mapping[ClosureStatus, frozenset[ClosureStatus]] = {
    ClosureStatus.CANDIDATE: frozenset(ClosureStatus),
    ClosureStatus.VERIFIED: frozenset(ClosureStatus) - {ClosureStatus.CANDIDATE},
    ClosureStatus.ACCEPTED: frozenset({ClosureStatus.ACCEPTED}),
}
"""Final statuses of the closures that passed each stage. Rejected and revoked closures were verified before. Revoked
closures do not count as accepted, because the final graph does not contain them."""

DISCARDED = (ClosureStatus.REJECTED, ClosureStatus.REVOKED)
"""Statuses of discarded closures, which are reported beside the stages."""


class ClosureScope(StrEnum):
    """Whether a closure connects poses of one robot or of two robots."""

    ROBOT = "intra_robot"
    FLEET = "inter_robot"


@dataclass(frozen=True, slots=True)
class ClosureScore:
    """Scores of one set of closures against the reference."""

    graph: Precision
    """Precision against the optimised graph of the relations."""
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
        EvaluationError: one of them cannot be read, or no relation names a stamp of the run.
    """
    graph = build_relation_graph(read_relations(relations))
    opened = open_run(run)
    poses = pose_table(opened)
    node_rows = poses.find(graph.stamps)
    if not np.any(node_rows >= 0):
        raise EvaluationError(f"{relations}: no relation names a stamp of {run}; are they of the same recording?")
    evidence = _gather(opened, poses, graph, node_rows)
    scores = {
        (within, status): evidence.score(members, within, status in STAGES)
        for (within, status), members in closure_sets(opened).items()
    }
    return ClosureReport(scores, graph, int(np.sum(node_rows >= 0)))


def closure_rows(run: Run, poses: PoseTable) -> Rows:
    """Rows of both ends of each closure in ``poses``, shape (K, 2); -1 if a stamp is missing or ambiguous."""
    robots = {robot: number for number, robot in enumerate(run.trajectories)}
    rows = np.full((len(run.closures), 2), -1, dtype=np.int64)
    for end, names, stamps in (
        (0, [c.robot_i for c in run.closures], [c.stamp_i for c in run.closures]),
        (1, [c.robot_j for c in run.closures], [c.stamp_j for c in run.closures]),
    ):
        numbers = np.array([robots.get(name, -1) for name in names], dtype=np.int64)
        for number in np.unique(numbers[numbers >= 0]):
            of_robot = np.flatnonzero(poses.robots == number)
            table = PoseTable.of(poses.stamps[of_robot], poses.T_map_base[of_robot])
            asked = np.flatnonzero(numbers == number)
            found = table.find(np.array(stamps)[asked])
            rows[asked, end] = np.where(found >= 0, of_robot[found], -1)
    return rows


def closure_metrics(report: ClosureReport) -> tuple[Metric, ...]:
    """The report as named numbers."""
    graph = report.relations
    sizes = graph.component_sizes
    metrics = [
        Metric("relations", len(graph.relations), "1"),
        Metric("relations_contradicted", int(np.sum(~graph.holds)), "1"),
        Metric("relation_residual_translation_median", _quantile(graph.residual_m, 0.5), "m"),
        Metric("relation_residual_translation_max", _quantile(graph.residual_m, 1.0), "m"),
        Metric("relation_residual_rotation_median", _quantile(graph.residual_deg, 0.5), "deg"),
        Metric("relation_residual_rotation_max", _quantile(graph.residual_deg, 1.0), "deg"),
        Metric("relation_stamps", len(graph.stamps), "1"),
        Metric("relation_stamps_in_run", report.stamps_in_run, "1"),
        Metric("relation_components", len(sizes), "1"),
        Metric("relation_stamps_in_largest_component", int(sizes.max(initial=0)), "1"),
    ]
    for (within, status), score in report.scores.items():
        name = f"{within}_{status}"
        metrics += _precision_metrics(name, score.graph)
        if score.recall is not None:
            metrics.append(Metric(f"{name}_revisits", score.recall.revisits, "1"))
            metrics.append(Metric(f"{name}_revisits_found", score.recall.found, "1"))
            metrics.append(Metric(f"{name}_recall", score.recall.recall, "1"))
        metrics.append(Metric(f"{name}_chain_median", score.chain[0], "relations"))
        metrics.append(Metric(f"{name}_chain_max", score.chain[1], "relations"))
        metrics += _precision_metrics(f"{name}_single_relation", score.single)
    return tuple(metrics)


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Errors and chains of all closures."""

    poses: PoseTable
    pairs: Rows
    """Rows of the ends of the closures, shape (K, 2)."""
    by_graph: ClosureErrors
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


def closure_sets(run: Run) -> dict[tuple[ClosureScope, ClosureStatus], Mask]:
    """Masks (K,) of the closures of each stage, and of discarded closures."""
    between = np.array([c.robot_i != c.robot_j for c in run.closures], dtype=np.bool_)
    sets: dict[tuple[ClosureScope, ClosureStatus], Mask] = {}
    for within, kind in ((ClosureScope.ROBOT, ~between), (ClosureScope.FLEET, between)):
        for status in (*STAGES, *DISCARDED):
            passed = STAGES.get(status, {status})
            sets[within, status] = kind & np.array([c.status in passed for c in run.closures], dtype=np.bool_)
    return sets


def _chains(graph: RelationGraph, node_rows: Rows, errors: ClosureErrors) -> FloatArray:
    """Number of relations between the ends of each closure, shape (K,); NaN if the graph does not cover it."""
    number_of = {row: number for number, row in enumerate(node_rows.tolist()) if row >= 0}
    covered = errors.covered
    pairs = np.array([(number_of[a], number_of[b]) for a, b in errors.ends[covered].tolist()], dtype=np.int64)
    chains = np.full(len(covered), np.nan)
    chains[covered] = graph.chain_lengths(pairs.reshape(-1, 2))
    return chains


def _precision_metrics(name: str, found: Precision) -> list[Metric]:
    return [
        Metric(f"{name}_closures", found.closures, "1"),
        Metric(f"{name}_covered", found.covered, "1"),
        Metric(f"{name}_coverage", found.coverage, "1"),
        Metric(f"{name}_wrong", found.wrong, "1"),
        Metric(f"{name}_precision", found.precision, "1"),
        Metric(f"{name}_translation_error_median", found.translation_m[0], "m"),
        Metric(f"{name}_translation_error_max", found.translation_m[1], "m"),
        Metric(f"{name}_rotation_error_median", found.rotation_deg[0], "deg"),
        Metric(f"{name}_rotation_error_max", found.rotation_deg[1], "deg"),
    ]


def _quantile(values: FloatArray, share: float) -> float:
    """Quantile of the finite ``values`` (K,); NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else np.nan
