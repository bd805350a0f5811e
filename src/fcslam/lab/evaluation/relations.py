"""The relations metric of run folders."""

import csv
from pathlib import Path

import numpy as np

from fcslam.errors import InputError, writing
from fcslam.metrics.relations import (
    ACROSS_ROBOTS_GAP_S,
    PoseTable,
    RelationErrors,
    read_relations,
    relation_errors,
    select,
)
from fcslam.runs import Metric, Run, metrics_json, open_run


def evaluate_relations(
    run: Path, relations: Path, across_robots: bool = False, parts: Path | None = None
) -> RelationErrors:
    """Errors of the run folder ``run`` against the file ``relations``.

    ``across_robots``: only relations whose stamps belong to different robots. ``parts`` is a run folder that assigns
    stamps to robots, if not ``run``: so a run of one robot is evaluated with the same relations as one of several
    robots from the same recording.
    """
    reference = read_relations(relations)
    poses = pose_table(open_run(run))
    robots = poses if parts is None else pose_table(open_run(parts))
    gap_s = ACROSS_ROBOTS_GAP_S if across_robots else 0.0
    selected = select(reference, robots, gap_s, across_robots)
    if not len(selected):
        which = "between different robots" if across_robots else "in it"
        raise InputError(f"{relations}: no relation {which} spans more than {gap_s:g} s")
    errors = relation_errors(selected, poses)
    if not errors.used:
        hint = "; the robots are in different maps, which closures.csv explains" if across_robots else ""
        raise InputError(f"{run}: none of the {errors.total} relations has both its poses in one map{hint}")
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
    """Write ``metrics`` as JSON if ``path`` ends in ``.json``, else as CSV with the columns name, value, unit."""
    with writing(path, "choose another place"), path.open("w", encoding="utf-8", newline="") as file:
        if path.suffix == ".json":
            file.write(metrics_json(metrics))
        else:
            rows = [(metric.name, f"{metric.value:.9g}", metric.unit) for metric in metrics]
            csv.writer(file, lineterminator="\n").writerows([("name", "value", "unit"), *rows])
