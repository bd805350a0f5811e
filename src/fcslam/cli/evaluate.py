"""`fcslam evaluate`: run folders against references."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.metrics.relations import RelationErrors

app = typer.Typer(no_args_is_help=True, help="Measure run folders against references.")


@app.callback()
def _evaluate() -> None:
    """Keeps `relations` a command of its own while it is the only one."""


@app.command(epilog="Example: fcslam evaluate relations out/intel intel.relations.gz --across-robots")
def relations(
    run: Annotated[Path, typer.Argument(help="The run folder to measure.")],
    reference: Annotated[Path, typer.Argument(metavar="RELATIONS", help="Relations file; .gz and .xz are read too.")],
    *,
    across_robots: Annotated[
        bool, typer.Option("--across-robots", help="Only relations between stamps of different robots.")
    ] = False,
    gap_s: Annotated[
        float | None,
        typer.Option(min=0.0, help="Only relations that span more seconds; 20 across robots, else everything."),
    ] = None,
    parts: Annotated[
        Path | None,
        typer.Option(
            help="Run folder that says which stamps belong to which robot, if not RUN: measures one robot's "
            "run by the relations of a run of several."
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="Write the numbers to this file as well (as JSON if it ends in .json).")
    ] = None,
) -> None:
    """Errors of a run by the relations metric of Kuemmerle et al. 2009: mean, standard deviation and maximum."""
    from fcslam.evaluation.relations import (
        RelationsQuestion,
        evaluate_relations,
        relation_metrics,
        write_metrics,
    )

    errors = evaluate_relations(run, reference, RelationsQuestion(across_robots, gap_s, parts))
    _show_relations(errors, "relations across robots" if across_robots else "relations")
    if csv is not None:
        write_metrics(relation_metrics(errors), csv)


def _show_relations(errors: "RelationErrors", what: str) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("error", "mean", "std", "max", caption=f"{errors.used} of {errors.total} {what} used")
    for name, spread, digits in (("translation, m", errors.translation, 4), ("rotation, deg", errors.rotation, 3)):
        table.add_row(name, *(f"{value:.{digits}f}" for value in (spread.mean, spread.std, spread.maximum)))
    Console().print(table)
