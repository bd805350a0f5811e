"""`fcslam demo`: a fleet simulated, taught, mapped together, measured against the truth, and drawn."""

import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.simulation.options import Building

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.mission import MissionConfig
    from fcslam.simulation.simulated_fleet import SimulatedFleet, SimulationSettings
    from fcslam.sources import Source

RECORDINGS, LEARNING, RUN, FIGURE, TABLE = "recordings", "learning", "run", "figure.png", "evaluation.csv"
STAGES = 5
ABOUT = "about"
"""It tells a folder that a demo wrote from one that holds somebody's work."""


def demo(
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything; a demo there is replaced.")] = (
        Path("demo")
    ),
    robots: Annotated[int, typer.Option(min=1, max=8, help="How many robots drive.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws another building.")] = 1,
    building: Annotated[Building, typer.Option(help="What kind of building.")] = Building.DEFAULT,
    path_length: Annotated[float, typer.Option(min=1.0, max=10_000.0, help="Metres that each robot drives.")] = 60.0,
    no_camera: Annotated[bool, typer.Option("--no-camera", help="LiDAR only; needs no GL library.")] = False,
) -> None:
    """Simulate a fleet whose robots do not know where they are, map it, compare the map with the truth, draw both."""
    from rich.console import Console

    from fcslam.cli.map import map_sources
    from fcslam.cli.simulate import record_fleet
    from fcslam.simulation.recording import prepare_fleet_folder
    from fcslam.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
    from fcslam.sources import open_source

    began = time.perf_counter()
    camera = None if no_camera else CameraSettings()
    settings = SimulationSettings(building=building, robots=robots, path_length_m=path_length, camera=camera)
    _check_libraries(settings)
    fleet = simulate_fleet(settings, seed)
    _prepare(output)
    prepare_fleet_folder(output / RECORDINGS, settings, seed, resume=False)
    console = Console(stderr=True)
    _announce(console, 1, f"simulate: {robots} robots drive {path_length:g} m each; none is told where it starts")
    recordings = record_fleet(fleet, output / RECORDINGS, seed, False, console)
    sources = [open_source(place) for place in recordings]
    config = _learn(sources, output / LEARNING, seed, camera is not None, console)
    _announce(console, 3, "map each robot, recognise places, fuse")
    map_sources(sources, config, output / RUN, force=True)
    _evaluate(output, console)
    _draw(output, fleet, console)
    typer.echo(f"{time.perf_counter() - began:.0f} s in all")
    for what, name in (("run folder", RUN), ("figure", FIGURE), ("every figure measured", TABLE)):
        typer.echo(f"{what}: {output / name}")


def _check_libraries(settings: "SimulationSettings") -> None:
    """Refuse before the work, and before an earlier demo is removed."""
    from fcslam.simulation.engine import gl_context, mujoco

    if settings.camera:
        gl_context(16, 16).free()
    else:
        mujoco()


def _prepare(output: Path) -> None:
    """A folder in which nothing of an earlier demo is left.

    Raises:
        OutputError: something else is there, or it cannot be written.
    """
    from fcslam.errors import OutputError

    try:
        output.mkdir(parents=True, exist_ok=True)
        if any(output.iterdir()) and not (output / ABOUT).is_file():
            raise OutputError(
                f"{output}: holds something that is no demo; remove it, or name another folder with --output"
            )
        names = (RECORDINGS, LEARNING, RUN, FIGURE, TABLE)
        (output / ABOUT).write_text(
            f"Written by `fcslam demo`, which replaces {', '.join(names)} here when it runs again.\n", encoding="utf-8"
        )
        for place in (output / name for name in names):
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be used as the output folder ({error})") from error


def _learn(sources: "Sequence[Source]", folder: Path, seed: int, camera: bool, console: "Console") -> "MissionConfig":
    """Train the detector for a moment where that can be done; the mission, with what came of it if it is no worse."""
    from fcslam.cli.demo_learning import learn_together, missing_libraries
    from fcslam.mission import MissionConfig

    config, missing = MissionConfig(seed=seed), missing_libraries()
    if not camera:
        _announce(console, 2, "learn: left out, there is no camera")
        return config
    if missing:
        how = "pip install 'fcslam\\[federated]'"  # escaped: brackets are the console's markup
        _announce(console, 2, f"learn: left out, as {' and '.join(missing)} are not installed; to have it: {how}")
        return config
    _announce(console, 2, "learn: the robots train the detector together, no image leaves its robot")
    released = learn_together(sources, folder, seed, console)
    if released is None:
        _say(console, "no round was as good on held-out images as what came with fcslam: the fleet keeps that")
        return config
    _say(console, "no worse on held-out images than what came with fcslam: the fleet takes it")
    onnx = config.robot.views.onnx.model_copy(update={"weights": released})
    views = config.robot.views.model_copy(update={"onnx": onnx})
    return config.model_copy(update={"robot": config.robot.model_copy(update={"views": views})})


def _evaluate(output: Path, console: "Console") -> None:
    from rich.console import Console

    from fcslam.cli.evaluate_fleet import show_fleet
    from fcslam.evaluation.fleet.metrics import fleet_metrics
    from fcslam.evaluation.fleet.relations import write_metrics
    from fcslam.evaluation.fleet.report import evaluate_fleet

    _announce(console, 4, "evaluate: compare with the truth")
    with _busy(console, "evaluating"):
        report = evaluate_fleet(output / RUN, output / RECORDINGS)
        write_metrics(fleet_metrics(report), output / TABLE)
    show_fleet(report, Console(), explained=False)
    typer.echo(f"What the columns mean: fcslam evaluate fleet {output / RUN}")


def _draw(output: Path, fleet: "SimulatedFleet", console: "Console") -> None:
    from fcslam.evaluation.fleet.charts import Outline, fleet_charts
    from fcslam.evaluation.fleet.figure import write_figure
    from fcslam.simulation.floorplan import PieceKind

    _announce(console, 5, "draw")
    with _busy(console, "drawing"):
        solid = [piece for piece in fleet.plan.pieces if piece.kind is not PieceKind.LINTEL]
        outlines = [Outline(piece.outline, piece.kind is not PieceKind.WALL) for piece in solid]
        write_figure(fleet_charts(output / RUN, output / RECORDINGS, outlines), output / FIGURE)


def _announce(console: "Console", stage: int, what: str) -> None:
    _say(console, f"[bold]{stage} of {STAGES}[/bold] {what}")


def _say(console: "Console", text: str) -> None:
    console.print(text, highlight=False, soft_wrap=True)


@contextmanager
def _busy(console: "Console", what: str) -> Iterator[None]:
    """A sign of life where somebody watches."""
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield
