"""`fcslam evaluate`: measure runs against references."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.options import Csv
from fcslam.cli.output import answers, notices, verdict_lines

if TYPE_CHECKING:
    from rich.console import Console

RunFolder = Annotated[Path, typer.Argument(help="Run folder to measure.")]

app = typer.Typer(no_args_is_help=True, help="Measure runs against references.")


@app.command()
def fleet(
    run: RunFolder,
    *,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Folder with ROBOT/ground_truth.tum or ROBOT.tum of each robot and, if known, the true map in "
            "ground_truth/map.yaml.",
            show_default="recordings beside the run, else the parent of the run",
        ),
    ] = None,
    csv: Csv = None,
) -> None:
    """Compare a run with the truth: trajectories, closures by channel and stage, joins, the map, and bytes sent."""
    report_fleet(run, truth, csv, notices())


def report_fleet(run: Path, truth: Path | None, csv: Path | None, notices: "Console") -> None:
    """Compare a run with the truth: print tables, and write the numbers to ``csv``."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.evaluation.relations import write_metrics
    from fcslam.lab.evaluation.report import evaluate_fleet, fleet_metrics
    from fcslam.lab.evaluation.tables import findings, fleet_tables

    with ProgressDisplay(notices) as display:
        display.start("evaluating")
        report = evaluate_fleet(run, truth)
    for table in fleet_tables(report):
        answers().print(table)
    typer.echo("\n".join(findings(report)))
    if csv is not None:
        write_metrics(fleet_metrics(report), csv)


@app.command()
def relations(
    run: RunFolder,
    reference: Annotated[
        Path, typer.Argument(metavar="RELATIONS", help="Relations file, plain or compressed by gzip or xz.")
    ],
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
    from fcslam.lab.evaluation.relations import evaluate_relations, relation_metrics, write_metrics
    from fcslam.lab.evaluation.tables import relations_table

    errors = evaluate_relations(run, reference, across_robots, parts)
    answers().print(relations_table(errors, "relations across robots" if across_robots else "relations"))
    if csv is not None:
        write_metrics(relation_metrics(errors), csv)


@app.command()
def quality(run: RunFolder) -> None:
    """Print whether to use each map of a run, why, and what to drive next."""
    from fcslam.runs import open_run

    typer.echo("\n".join(verdict_lines(open_run(run, maps=False).verdict)))
