"""`fcslam evaluate federated`: compare central, federated and local-only training."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.mission_options import SettingsFiles, chosen_settings
from fcslam.cli.options import output_option
from fcslam.cli.output import EVALUATIONS, answers, new_folder, notices, print_line
from fcslam.cli.training_options import TRAINING_OUTPUT, compute_budget, require_training_libraries

if TYPE_CHECKING:
    from rich.table import Table

    from fcslam.lab.evaluation.federated.report import ArmReport


def federated(
    robots: Annotated[
        list[Path], typer.Argument(help="Folders of images, one for each robot. The folder names the robot.")
    ],
    *,
    output: Annotated[Path | None, output_option(TRAINING_OUTPUT, EVALUATIONS)] = None,
    config: SettingsFiles = None,
) -> None:
    """Train centrally, federated and on each robot alone, with equal starts and sample counts, and compare."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.errors import EvaluationError

    require_training_libraries("flwr", extra="federated")
    from fcslam.lab.evaluation.federated.report import report, write_report
    from fcslam.lab.evaluation.federated.study import Study, StudySettings, run_study

    folders = {folder.resolve().name: folder for folder in robots}
    if len(folders) < max(len(robots), 2):
        raise EvaluationError("at least two robots are needed, in folders of different names")
    settings = chosen_settings(StudySettings(), config)
    output = output or new_folder(EVALUATIONS)
    with ProgressDisplay(notices(), f"output: {output}") as display:
        findings = run_study(Study(folders, output, settings, compute_budget(), display.show))
    reports = report(findings)
    write_report(reports, output / "report.csv")
    console = answers()
    console.print(_table(reports))
    pairs = len(findings.owners)
    print_line(
        console,
        f"{pairs} pairs. Gap: central minus the arm on the same seeds, 95 % interval by bootstrap over pairs.",
    )
    print_line(console, f"all numbers: {output / 'report.csv'}")


def _table(reports: "list[ArmReport]") -> "Table":
    from rich.table import Table

    table = Table(title="Federated training", title_justify="left")
    for name in ("measure", "arm", "seeds", "mean", "gap to central", "gap closed", "of alone", "worst robot"):
        table.add_column(name)
    for each in reports:
        gap = f"{100 * each.gap.mean:.1f} [{100 * each.gap.low:.1f}, {100 * each.gap.high:.1f}]"
        closed = [f"{share:.2f}".replace("nan", "") for share in (each.closed, each.closed_alone)]
        worst = f"{each.worst_robot} {100 * each.worst_gap:.1f}"
        table.add_row(each.measure, each.arm, str(len(each.seeds)), f"{100 * each.mean:.1f}", gap, *closed, worst)
    return table
