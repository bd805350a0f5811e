"""`fcslam evaluate relations`: the errors of a run by the relations metric."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.evaluate.arguments import Reference, RunFolder
from fcslam.cli.options import Csv
from fcslam.cli.output import answers

if TYPE_CHECKING:
    from fcslam.metrics.relations import RelationErrors


def relations(
    run: RunFolder,
    reference: Reference,
    *,
    across_robots: Annotated[
        bool, typer.Option("--across-robots", help="Use only relations between stamps of different robots.")
    ] = False,
    parts: Annotated[
        Path | None,
        typer.Option(
            help="Run folder that assigns the stamps to robots. It lets you measure the run of one robot on the "
            "relations across the robots of another run.",
            show_default="RUN",
        ),
    ] = None,
    csv: Csv = None,
) -> None:
    """Measure a run by the relations metric of Kuemmerle et al. 2009: mean, standard deviation and maximum."""
    from fcslam.lab.evaluation.fleet.relations import (
        evaluate_relations,
        relation_metrics,
        write_metrics,
    )

    errors = evaluate_relations(run, reference, across_robots, parts)
    _show_relations(errors, "relations across robots" if across_robots else "relations")
    if csv is not None:
        write_metrics(relation_metrics(errors), csv)


def _show_relations(errors: "RelationErrors", what: str) -> None:
    from rich.table import Table

    table = Table("error", "mean", "std", "max", caption=f"{errors.used} of {errors.total} {what} used")
    for name, spread, digits in (("translation, m", errors.translation, 4), ("rotation, deg", errors.rotation, 3)):
        table.add_row(name, *(f"{value:.{digits}f}" for value in (spread.mean, spread.std, spread.maximum)))
    answers().print(table)
