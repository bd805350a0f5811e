"""The relations metric of run folders."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fcslam.errors import EvaluationError, writing
from fcslam.metrics.relations import (
    ACROSS_ROBOTS_GAP_S,
    PoseTable,
    RelationErrors,
    read_relations,
    relation_errors,
    select,
)
from fcslam.runs import Metric, Run, metrics_json, open_run


@dataclass(frozen=True, slots=True)
class RelationsQuestion:
    """Selection of relations."""

    across_robots: bool = False
    """Only relations whose stamps belong to different robots."""
    parts: Path | None = None
    """Run folder that assigns stamps to robots, if not the evaluated one. It lets you evaluate a run of one robot with
    the same relations as a run of several robots from the same recording."""

    @property
    def gap_s(self) -> float:
        """Smallest time between the stamps of a relation that counts."""
        return ACROSS_ROBOTS_GAP_S if self.across_robots else 0.0


def evaluate_relations(run: Path, relations: Path, question: RelationsQuestion) -> RelationErrors:
    """Errors of the run folder ``run`` against the file ``relations``.

    Raises:
        EvaluationError: one of them cannot be read, no relation is selected, or none has both its poses in one map of
            the run.
    """
    reference = read_relations(relations)
    poses = pose_table(open_run(run))
    robots = poses if question.parts is None else pose_table(open_run(question.parts))
    selected = select(reference, robots, question.gap_s, question.across_robots)
    if not len(selected):
        which = "between different robots" if question.across_robots else "in it"
        raise EvaluationError(f"{relations}: no relation {which} spans more than {question.gap_s:g} s")
    errors = relation_errors(selected, poses)
    if not errors.used:
        hint = "; the robots are in different maps, which closures.csv explains" if question.across_robots else ""
        raise EvaluationError(f"{run}: none of the {errors.total} relations has both its poses in one map{hint}")
    return errors


def pose_table(run: Run) -> PoseTable:
    """All poses of ``run`` in one table; robots are numbered in the run's order."""
    if not run.trajectories:
        return PoseTable.of([], np.empty((0, 3)))
    counts = [len(trajectory.stamps) for trajectory in run.trajectories.values()]
    return PoseTable.of(
        np.concatenate([trajectory.stamps for trajectory in run.trajectories.values()]),
        np.concatenate([trajectory.T_map_base for trajectory in run.trajectories.values()]),
        robots=np.repeat(np.arange(len(counts)), counts),
        maps=np.repeat([trajectory.map_index for trajectory in run.trajectories.values()], counts),
    )


def relation_metrics(errors: RelationErrors) -> tuple[Metric, ...]:
    """List the errors as metrics."""
    spreads = (("translation", errors.translation, "m"), ("rotation", errors.rotation, "deg"))
    return (
        *(
            Metric(f"{name}_error_{which}", value, unit)
            for name, spread, unit in spreads
            for which, value in (("mean", spread.mean), ("std", spread.std), ("max", spread.maximum))
        ),
        Metric("relations_used", errors.used, "relations"),
        Metric("relations_total", errors.total, "relations"),
    )


def write_metrics(metrics: tuple[Metric, ...], path: Path) -> None:
    """Write ``metrics`` as JSON if ``path`` ends in ``.json``, else as CSV with the columns name, value, unit.

    Raises:
        OutputError: the file cannot be written.
    """
    with writing(path, "choose another place"), path.open("w", encoding="utf-8", newline="") as file:
        if path.suffix == ".json":
            file.write(metrics_json(metrics))
        else:
            rows = [(metric.name, f"{metric.value:.9g}", metric.unit) for metric in metrics]
            csv.writer(file, lineterminator="\n").writerows([("name", "value", "unit"), *rows])
