"""`fcslam evaluate quality`: the certificate of a run, and whether it is right."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.evaluate.arguments import RunFolder
from fcslam.cli.options import Csv
from fcslam.cli.output import answers, print_line


def quality(
    run: RunFolder,
    *,
    truth: Annotated[
        Path | None,
        typer.Option(help="Folder with the true poses; the cells of the certificate are compared with them."),
    ] = None,
    csv: Csv = None,
) -> None:
    """Print how good the maps of a run are and what to drive again; with --truth, compare with the truth."""
    from rich.table import Table

    from fcslam.lab.evaluation.fleet.quality import certificates_of, evaluate_quality
    from fcslam.lab.evaluation.fleet.relations import write_metrics
    from fcslam.runs import open_run

    console = answers()
    for k, one in certificates_of(open_run(run), run).items():
        limit = one["bar"]
        good = sum(cell["bound_95"] <= limit for cell in one["cells"])
        print_line(
            console, f"map {k}: {good} of {len(one['cells'])} m2 are good to {limit:g} m within {one['within']:g} m"
        )
        for stretch in one["open_stretches"]:
            print_line(
                console,
                f"map {k}: open: {stretch['robot']} for {stretch['length']:g} m from {stretch['from']} to "
                f"{stretch['to']}; the scans do not fix the motion along it",
            )
        for drive in one["drives"]:
            print_line(console, f"map {k}: {drive['text']}")
    if truth is None:
        return
    metrics = evaluate_quality(run, truth).metrics()
    table = Table("against the truth", "value")
    for metric in metrics:
        table.add_row(metric.name, f"{metric.value:.4g}")
    console.print(table)
    if csv is not None:
        write_metrics(tuple(metrics), csv)
