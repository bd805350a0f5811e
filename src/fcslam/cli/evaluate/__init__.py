"""`fcslam evaluate`: measure runs against references."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.options import Csv
from fcslam.cli.output import notices, verdict_lines

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
    from fcslam.cli.evaluate.fleet_tables import report_fleet

    report_fleet(run, truth, csv, notices())


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
    from fcslam.cli.evaluate.fleet_tables import show_relations
    from fcslam.lab.evaluation.relations import evaluate_relations, relation_metrics, write_metrics

    errors = evaluate_relations(run, reference, across_robots, parts)
    show_relations(errors, "relations across robots" if across_robots else "relations")
    if csv is not None:
        write_metrics(relation_metrics(errors), csv)


@app.command()
def quality(run: RunFolder) -> None:
    """Print whether to use each map of a run, why, and what to drive next."""
    from fcslam.runs import open_run

    typer.echo("\n".join(verdict_lines(open_run(run, maps=False).verdict)))
