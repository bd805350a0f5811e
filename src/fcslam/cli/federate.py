"""`fcslam federate`: a detector from many robots' images, which stay where they are."""

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fcslam.cli.train import need_torch, pace_on

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from fcslam.federated.history import RoundReport
    from fcslam.federated.job import FederatedJob, ProgressCallbacks
    from fcslam.federated.settings import FederatedSettings
    from fcslam.learning.trainer import TrainingProgress

QUICK = {"rounds": 3, "local_steps": 6, "judge_every": 1}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Enough to see that everything works, and no more."""


def federate(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(help="One folder of images for each robot, named like it; one with --join, none with --serve."),
    ] = None,
    *,
    local: Annotated[bool, typer.Option("--local", help="All robots in this process.")] = False,
    serve: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Robots join this machine, there.")] = None,
    join: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Be a robot of the server there.")] = None,
    name: Annotated[str | None, typer.Option(help="With --join the robot's name; else its folder's.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for all that is made; the same one resumes.")],
    config: Annotated[Path | None, typer.Option(help="YAML file of federated settings.")] = None,
    start: Annotated[
        Path | None,
        typer.Option(help="checkpoint.npz or detector.onnx of a training to begin from; without it, synthetic shapes."),
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
    ca: Annotated[Path | None, typer.Option(help="Certificate that all others of the fleet are signed by.")] = None,
    certificate: Annotated[Path | None, typer.Option(help="This machine's certificate.")] = None,
    key: Annotated[Path | None, typer.Option(help="Its private key.")] = None,
    robot_key: Annotated[
        list[Path] | None,
        typer.Option(help="With --serve public keys of the robots that may join; with --join the private one."),
    ] = None,
    insecure: Annotated[bool, typer.Option("--insecure", help="Neither encrypted nor authenticated.")] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="A minute's run that only shows that everything works.")
    ] = False,
) -> None:
    """Train one detector on many robots' images, none of which leaves its robot."""
    from fcslam.errors import TrainingError

    if local + (serve is not None) + (join is not None) != 1:
        raise TrainingError("say where the robots are: --local, --serve HOST:PORT or --join HOST:PORT")
    given = {"strategy": strategy, "rounds": rounds, "local_steps": local_steps}
    settings = _settings(config, quick, {name: value for name, value in given.items() if value is not None}, seed)
    need_torch("flwr", extra="federated")
    from fcslam.federated.job import FederatedJob

    task = FederatedJob(output, settings, start, tuple(public or ()))
    if local:
        _run_locally(folders or [], task, device, quick)
        return
    from fcslam.cli.federate_apart import Security, run_robot, run_server

    security = Security(ca, certificate, key, tuple(robot_key or ()), insecure)
    if serve is not None:
        run_server(serve, task, device, security, folders or [])
    elif join is not None:
        run_robot(join, folders or [], output, device, security, name)


def _run_locally(folders: list[Path], task: "FederatedJob", device: str, quick: bool) -> None:
    import time

    from rich.console import Console

    from fcslam.errors import TrainingError
    from fcslam.federated.local import federate_locally

    if not folders:
        raise TrainingError("--local needs a folder of images for each robot")
    console = Console(stderr=True)
    began = time.perf_counter()
    with _progress(console, task.settings) as watches:
        files = federate_locally(folders, task, pace_on(device, quick), watches)
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
def _progress(console: Any, settings: "FederatedSettings") -> "Iterator[ProgressCallbacks]":
    """A live line for the rounds, one for the robot at work, and one a stage before; a printed line for each round."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from fcslam.federated.job import ProgressCallbacks

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def show(name: str, done: int, of: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=of)
            bar.update(tasks[name], completed=done, total=of)

        def stage(name: str, status: "TrainingProgress") -> None:
            show(name, status.step, status.steps)

        def steps(robot: str, done: int) -> None:
            show("robot", done, settings.local_steps)
            bar.update(tasks["robot"], description=robot)

        def rounds(report: "RoundReport") -> None:
            show("rounds", report.round_number, settings.rounds)
            console.print(line_of(report.row(), settings.rounds), highlight=False, soft_wrap=True)

        yield ProgressCallbacks(stage, steps, rounds)


def line_of(row: "Mapping[str, str]", rounds: int) -> str:
    """A round in a line."""
    released, returned, judged = row["released"] == "1", row["returned"] == "1", row["score"] != "nan"
    outcome = "back to the best" if returned else "not released" if judged else "not judged"
    shown = {"detector": "loss_detector", "contrastive": "loss_contrastive", "repeatability": "repeatability",
             "MMA": "mma_3px"}  # fmt: skip
    parts = [
        f"round {row['round']}/{rounds}",
        f"{len(row['robots'].split(' | '))} robots",
        *(f"{name} {float(row[column]):.3f}" for name, column in shown.items() if row.get(column)),
        f"down {float(row['bytes_down']) / 1e6:.1f} MB, up {float(row['bytes_up']) / 1e6:.1f} MB",
        f"released {row['version']}" if released else outcome,
        *([f"without {row['left_out']}"] if row["left_out"] else []),
    ]
    return "  ".join(parts)
