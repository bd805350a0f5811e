"""How many closures are true and how many revisits they find: the split runs against the reference relations.

    FCSLAM_DATA=/path/to/data python benchmarks/closures.py

The relations are optimized together, so that they place stamps to each other that
no single one joins; a closure is covered if both its stamps lie within 1 s of such stamps in one component, and the gap
is bridged by the run's own trajectory. "One relation" asks the same of a single relation, without any chain. A covered
closure is wrong if it is off by more than 0.5 m or 10 deg. A revisit is a relation between robots more than 20 s apart,
or within a robot more than 60 s; it is found if a correct closure ends within 2 m of path at both sides. A closure that
nothing covers finds nothing, so recall is a lower bound.
"""

import tempfile
from pathlib import Path

import common
import numpy as np
from evaluation.relation_closures import ClosureReport, evaluate_closures

from fcslam.lab.evaluation.closures import STAGES, ClosureScope

SETS = {"log": "", "closures": "", "stage": ""}
COUNTS = {**SETS, "all": "", "covered": "", "coverage": ".1%", "wrong": "", "precision": ".2%", "revisits": "",
          "found": "", "recall": ".1%"}  # fmt: skip
SPREAD = {"median, m": ".3f", "max, m": ".3f", "median, deg": ".2f", "max, deg": ".2f"}
ERRORS = {**SETS, "covered": "", **SPREAD, "median chain": ".0f", "longest chain": ".0f"}
SINGLE = {**SETS, "all": "", "covered": "", "coverage": ".1%", "wrong": "", **SPREAD}
REFERENCE = {"log": "", "relations": "", "contradicted": "", "components": "", "stamps": "", "in the largest": "",
             **{f"residual: {name}": spec for name, spec in SPREAD.items()}}  # fmt: skip
NAMES = {ClosureScope.ROBOT: "within robots", ClosureScope.FLEET: "between robots"}


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    reports = {}
    with tempfile.TemporaryDirectory() as place:
        for name, parts in common.SPLITS.items():
            run = Path(place) / name
            common.run_fcslam("map", common.log_path(folder, name), "--output", run, "--split", parts)
            reports[name] = evaluate_closures(run, common.relations_path(folder, name))
    report.say(
        "Stages are cumulative: what was verified was a candidate, what was accepted was verified. Rejected and "
        "revoked closures stand beside them. A robot reports only closures that it accepts."
    )
    rows = {name: table_rows(name, found) for name, found in reports.items()}
    for k, (title, columns) in enumerate(
        (("Precision and recall", COUNTS), ("Errors", ERRORS), ("One relation alone", SINGLE))
    ):
        report.table(title, columns, [row[k] for found in rows.values() for row in found])
    report.table("The relations themselves", REFERENCE, [reference_row(*item) for item in reports.items()])
    report.write()


def table_rows(log: str, report: ClosureReport) -> list[tuple[tuple, tuple, tuple]]:
    """Each set's row in the three tables; within robots the stages before acceptance are not known."""
    rows = []
    for (within, status), score in report.scores.items():
        if within is ClosureScope.ROBOT and status in STAGES and STAGES[status] != {status}:
            continue
        graph, single, recall = score.graph, score.single, score.recall
        head = (log, NAMES[within], status.value)
        found = ("", "", np.nan) if recall is None else (recall.revisits, recall.found, recall.recall)
        counts = (graph.closures, graph.covered, graph.coverage, graph.wrong, graph.precision)
        by_one = (single.closures, single.covered, single.coverage, single.wrong)
        rows.append((
            (*head, *counts, *found),
            (*head, graph.covered, *graph.translation_m, *graph.rotation_deg, *score.chain),
            (*head, *by_one, *single.translation_m, *single.rotation_deg),
        ))  # fmt: skip
    return rows


def reference_row(log: str, report: ClosureReport) -> tuple:
    graph = report.relations
    sizes = graph.component_sizes
    counts = len(graph.relations), int(np.sum(~graph.holds)), len(sizes), len(graph.stamps), int(sizes.max(initial=0))
    residuals = (graph.residual_m, graph.residual_deg)
    return log, *counts, *(choose(values) for values in residuals for choose in (np.nanmedian, np.nanmax))


if __name__ == "__main__":
    main()
