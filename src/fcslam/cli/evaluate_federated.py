"""`fcslam evaluate federated`: central, federated and local-only training, compared."""

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.table import Table

    from fcslam.evaluation.federated.report import ArmReport


def federated(
    robots: Annotated[list[Path], typer.Argument(help="One folder of images for each robot, named like it.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for all that is made; the same one resumes.")],
    config: Annotated[Path | None, typer.Option(help="YAML file of the study's settings.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, or auto: cuda if there is one.")] = "auto",
) -> None:
    """Train centrally, together, and each robot alone, from one start with as many samples, and measure all of them."""
    from rich.console import Console

    from fcslam.cli.train import need_torch, pace_on
    from fcslam.config import load
    from fcslam.errors import EvaluationError

    need_torch("flwr", extra="federated")
    from fcslam.evaluation.federated.report import report, write_report
    from fcslam.evaluation.federated.study import Study, StudySettings, run_study

    folders = {folder.resolve().name: folder for folder in robots}
    if len(folders) < max(len(robots), 2):
        raise EvaluationError("at least two robots are needed, in folders of different names")
    settings = StudySettings() if config is None else load(StudySettings, config)
    console = Console(stderr=True)
    with _progress(console) as watch:
        findings = run_study(Study(folders, output, settings, pace_on(device, False), watch))
    reports = report(findings)
    write_report(reports, output / "report.csv")
    console = Console()
    console.print(_table(reports))
    pairs = len(findings.owners)
    console.print(
        f"{pairs} pairs. Gap: central minus the arm on the same seeds, 95 % interval by bootstrap over pairs."
    )


@contextmanager
def _progress(console: Any) -> "Iterator[Callable[[str, int, int], None]]":
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def watch(name: str, done: int, of: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=of)
            bar.update(tasks[name], completed=done, total=of)
            if done == of and not console.is_terminal and name != "measuring":
                console.print(f"{name}: done", highlight=False)

        yield watch


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
