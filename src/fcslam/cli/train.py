"""`fcslam train`: a detector from a folder of images."""

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fcslam.learning.settings import TrainingSettings
    from fcslam.learning.stages import StageCallback
    from fcslam.learning.trainer import TrainingProgress

QUICK = {"steps": 40, "shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Enough to see that everything works, and no more."""
LINE_EVERY = 500
"""Steps between two lines of figures where there is no terminal."""
FIGURES = ("repeatability", "mma_3px", "shift_repeatability")


def train(
    images: Annotated[list[Path], typer.Argument(help="Folders of images; those inside are found too.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for all that is made; the same one resumes.")],
    config: Annotated[Path | None, typer.Option(help="YAML file of training settings.")] = None,
    encoder: Annotated[str | None, typer.Option(help="light, or vgg as in the paper.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of joint training; more than before goes on.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Another seed trains another detector.")] = None,
    teacher: Annotated[Path | None, typer.Option(help="Folder of a teacher's points, see docs/training.md.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, or auto: cuda if there is one.")] = "auto",
    quick: Annotated[
        bool, typer.Option("--quick", help="A minute's run that only shows that everything works.")
    ] = False,
) -> None:
    """Train a detector of keypoints with 256-bit descriptors; needs no labels."""
    import time

    from rich.console import Console

    settings = _settings(config, quick, {"encoder": encoder, "steps": steps, "seed": seed})
    need_torch()
    from fcslam.learning.artifacts import write_training_artifacts
    from fcslam.learning.stages import train_detector

    console = Console(stderr=True)
    began = time.perf_counter()
    with _progress(console) as watch:
        network, found = train_detector(images, output, settings, pace_on(device, quick), teacher, watch)
    files = write_training_artifacts(network, output, settings, found, teacher)
    for file in files:
        typer.echo(str(file))
    console.print(
        f"{time.perf_counter() - began:.0f} s; {len(found.train)} images, {len(found.held_out)} held out, "
        f"{found.skipped} left out",
        highlight=False,
    )


def _settings(config: Path | None, quick: bool, given: dict[str, Any]) -> "TrainingSettings":
    from fcslam.config import load, parse
    from fcslam.learning.settings import TrainingSettings

    base = TrainingSettings() if config is None else load(TrainingSettings, config)
    changes = (QUICK if quick else {}) | {name: value for name, value in given.items() if value is not None}
    return parse(TrainingSettings, base.model_dump() | changes, "the command line")


def need_torch(*others: str, extra: str = "train") -> None:
    """Raise TrainingError if a library of training, or one of ``others``, is missing."""
    from importlib.util import find_spec

    from fcslam.errors import TrainingError

    missing = [name for name in ("torch", "onnx", "onnxruntime", *others) if find_spec(name) is None]
    if missing:
        raise TrainingError(f"training needs {', '.join(missing)}; install it with: pip install 'fcslam[{extra}]'")


def pace_on(device: str, quick: bool) -> Any:
    """How to train on a device; raises TrainingError if it cannot be used."""
    import os

    import torch

    from fcslam.errors import TrainingError
    from fcslam.learning.trainer import ExecutionOptions

    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise TrainingError(f"--device {device}: cannot be used ({error}); give cpu") from error
    threads = 1 if device == "cpu" else max((os.cpu_count() or 2) - 1, 1)
    every = 20 if quick else 500
    return ExecutionOptions(device=device, threads=threads, validate_every=every, log_every=every if quick else 50)


@contextmanager
def _progress(console: Any) -> "Iterator[StageCallback]":
    """A live line a stage; without a terminal, a line of figures now and then."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    live = console.is_terminal
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[figures]}"),
    )
    with Progress(*columns, console=console, disable=not live) as bar:
        tasks: dict[str, Any] = {}
        said: set[str] = set()

        def say(text: str) -> None:
            if text not in said:
                said.add(text)
                console.print(text, highlight=False)

        def watch(stage: str, status: "TrainingProgress") -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=status.steps, figures="")
            text = "  ".join(f"{name} {status.figures[name]:.3f}" for name in FIGURES if name in status.figures)
            bar.update(tasks[stage], completed=status.step, figures=text)
            if not live and text and status.step % LINE_EVERY == 0:
                say(f"{stage} {status.step}/{status.steps}  {text}")
            for alarm in status.collapse_warnings:
                say(f"warning: {alarm}")

        yield watch
