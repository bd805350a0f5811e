"""`fcslam federate`: a detector from many robots' images, which stay where they are."""

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fcslam.cli.train import need_torch, pace_on

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fcslam.federated.history import RoundReport
    from fcslam.federated.local import Watches
    from fcslam.federated.settings import FederatedSettings
    from fcslam.learning.trainer import Status

QUICK = {"rounds": 3, "local_steps": 6}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Enough to see that everything works, and no more."""


def federate(
    folders: Annotated[list[Path], typer.Argument(help="One folder of images for each robot, named like it.")],
    *,
    local: Annotated[bool, typer.Option("--local", help="All robots in this process.")] = False,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for all that is made; the same one resumes.")],
    config: Annotated[Path | None, typer.Option(help="YAML file of federated settings.")] = None,
    start: Annotated[
        Path | None, typer.Option(help="checkpoint.npz of a training to begin from; without it, synthetic shapes.")
    ] = None,
    public: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of images that the server may judge detectors by; may be given several times."),
    ] = None,
    strategy: Annotated[
        str | None, typer.Option(help="fedavg, fedprox, fedadam, fedmedian, fedtrimmedavg or krum.")
    ] = None,
    rounds: Annotated[int | None, typer.Option(min=1, help="Rounds; more than before goes on.")] = None,
    local_steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps of a robot in a round.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Another seed trains another detector.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, or auto: cuda if there is one.")] = "auto",
    quick: Annotated[
        bool, typer.Option("--quick", help="A minute's run that only shows that everything works.")
    ] = False,
) -> None:
    """Train one detector on many robots' images, none of which leaves its robot."""
    import time

    from rich.console import Console

    from fcslam.errors import TrainingError

    if not local:
        raise TrainingError("say where the robots are: --local for all of them in this process")
    given = {"strategy": strategy, "rounds": rounds, "local_steps": local_steps}
    settings = _settings(config, quick, {name: value for name, value in given.items() if value is not None}, seed)
    need_torch("flwr", extra="federated")
    from fcslam.federated.local import Task, federate_locally

    console = Console(stderr=True)
    began = time.perf_counter()
    with _progress(console, settings) as watches:
        task = Task(folders, output, settings, start, tuple(public or ()))
        files = federate_locally(task, pace_on(device, quick), watches)
    for file in files:
        typer.echo(str(file))
    console.print(f"{time.perf_counter() - began:.0f} s", highlight=False)


def _settings(config: Path | None, quick: bool, given: dict[str, Any], seed: int | None) -> "FederatedSettings":
    from fcslam.config import load, parse
    from fcslam.federated.settings import FederatedSettings

    content = (FederatedSettings() if config is None else load(FederatedSettings, config)).model_dump()
    if quick:
        content |= QUICK
        content["training"] |= QUICK_TRAINING
    if seed is not None:
        content["training"]["seed"] = seed
    return parse(FederatedSettings, content | given, "the command line")


@contextmanager
def _progress(console: Any, settings: "FederatedSettings") -> "Iterator[Watches]":
    """A live line for the rounds, one for the robot at work, and one a stage before; a printed line for each round."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from fcslam.federated.local import Watches

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def show(name: str, done: int, of: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=of)
            bar.update(tasks[name], completed=done, total=of)

        def stage(name: str, status: "Status") -> None:
            show(name, status.step, status.steps)

        def steps(robot: str, done: int) -> None:
            show("robot", done, settings.local_steps)
            bar.update(tasks["robot"], description=robot)

        def rounds(report: "RoundReport") -> None:
            show("rounds", report.round_number, settings.rounds)
            console.print(line_of(report, settings.rounds), highlight=False, soft_wrap=True)

        yield Watches(stage, steps, rounds)


def line_of(report: "RoundReport", rounds: int) -> str:
    """A round in a line."""
    parts = [
        f"round {report.round_number}/{rounds}",
        f"{len(report.robots)} robots",
        *(f"{name} {report.losses[name]:.3f}" for name in ("detector", "contrastive") if name in report.losses),
        f"down {report.bytes_down / 1e6:.1f} MB, up {report.bytes_up / 1e6:.1f} MB",
        *(f"{name} {report.figures[name]:.3f}" for name in ("repeatability", "mma_3px") if name in report.figures),
        f"released {report.version}" if report.released else "back to the best" if report.returned else "not released",
        *(f"without {robot}: {reason}" for robot, reason in sorted(report.left_out.items())),
    ]
    return "  ".join(parts)
