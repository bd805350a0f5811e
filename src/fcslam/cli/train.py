"""`fcslam tools train`: train a detector on a folder of images."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.options import SettingsFiles, chosen_settings, output_option
from fcslam.cli.output import TRAINING, new_folder, notices, once_printer, print_line
from fcslam.cli.training_options import TRAINING_OUTPUT, Start, compute_budget, require_training_libraries

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.network import KeypointNetwork
    from fcslam.learning.settings import TrainingSettings
    from fcslam.learning.stages import StageCallback


def train(
    images: Annotated[list[Path], typer.Argument(help="Folders of images, searched with all their subfolders.")],
    *,
    output: Annotated[Path | None, output_option(TRAINING_OUTPUT, TRAINING)] = None,
    config: SettingsFiles = None,
    teacher: Annotated[
        Path | None, typer.Option(help="Folder with the keypoints of a teacher network, of tools/teacher_points.py.")
    ] = None,
    start: Start = None,
) -> None:
    """Train a detector of keypoints with 256-bit descriptors on images without labels."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.settings import TrainingSettings

    settings = chosen_settings(TrainingSettings(), config)
    require_training_libraries()
    from fcslam.learning.artifacts import write_artifacts
    from fcslam.learning.stages import train_detector, training_report

    console = notices()
    output = output or new_folder(TRAINING)
    began = time.perf_counter()
    with ProgressDisplay(console, f"output: {output}") as display:
        watch, options = _watch(display, console), compute_budget()
        begun = None if teacher is not None and start is None else _start_network(start, output, settings, images)
        network, found = train_detector(images, output, settings, options, teacher, watch, start=begun)
    files = write_artifacts(network, output, "training.png", settings, training_report(output, found, teacher))
    for file in files:
        typer.echo(str(file))
    held_out = len(found.held_out) if found.are_held_out else 0
    seconds, images_read = time.perf_counter() - began, len(found.train)
    print_line(console, f"{seconds:.0f} s; {images_read} images, {held_out} held out, {found.skipped} left out")


def _start_network(
    start: Path | None, output: Path, settings: "TrainingSettings", images: list[Path]
) -> "KeypointNetwork":
    from fcslam.learning.federated.initial_weights import prepare_initial_weights
    from fcslam.learning.federated.networks import weights_to_network
    from fcslam.learning.images import read_usable_images

    weights = prepare_initial_weights(start, output, settings.encoder, read_usable_images(images))
    return weights_to_network(weights, settings.encoder)


def _watch(display: "ProgressDisplay", console: "Console") -> "StageCallback":
    print_once = once_printer(console)

    def watch(stage: str, step: int, steps: int, metrics: "Mapping[str, float]", warnings: tuple[str, ...]) -> None:
        known = [name for name in ("repeatability", "mma_3px") if name in metrics]
        figures = "  ".join(f"{name} {metrics[name]:.3f}" for name in known)
        display.show(stage, step, steps, figures)
        if figures and step == steps:
            print_once(f"{stage} {step}/{steps}  {figures}")
        for alarm in warnings:
            print_once(f"warning: {alarm}")

    return watch
