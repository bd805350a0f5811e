"""`fcslam demo`: simulate a fleet, map it, and compare the map with the truth."""

import shutil
import time
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.options import BuildingSeed, NoCamera, PathLength, Quiet
from fcslam.cli.output import notices, print_line
from fcslam.errors import InputError
from fcslam.lab.simulation.options import Scanner

RECORDINGS, RUN, TABLE = "recordings", "run", "evaluation.csv"
ABOUT = "about"
"""The file that marks a folder as the output of a demo, which the next demo may replace."""


def demo(
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for all results. A demo in it is replaced.")
    ] = Path("demo"),
    robots: Annotated[int, typer.Option(min=1, max=8, help="Number of robots.")] = 3,
    seed: BuildingSeed = 1,
    path_length: PathLength = None,
    no_camera: NoCamera = False,
    quiet: Quiet = False,
) -> None:
    """Simulate robots with unknown starts, map them, and compare the map with the truth."""
    from fcslam.cli.evaluate import report_fleet
    from fcslam.cli.map import map_sources
    from fcslam.cli.simulate import record_fleet
    from fcslam.lab.simulation.engine import gl_context, mujoco
    from fcslam.lab.simulation.noise import SCANNERS
    from fcslam.lab.simulation.recording import prepare_fleet_folder
    from fcslam.lab.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
    from fcslam.mission.mission import MissionConfig, MissionInputs
    from fcslam.sources import open_source

    began = time.perf_counter()
    camera = None if no_camera else CameraSettings()
    settings = SimulationSettings(
        robots=robots,
        path_length_m=60.0 if path_length is None else path_length,
        lidar=SCANNERS[Scanner.LD19],
        camera=camera,
    )
    if camera is None:  # before an earlier demo is removed: everything can run
        mujoco()
    else:
        gl_context(16, 16).free()
    fleet = simulate_fleet(settings, seed)
    _prepare(output)
    prepare_fleet_folder(output / RECORDINGS, settings, seed)
    console = notices(quiet)
    path_m = settings.path_length_m
    print_line(console, f"1 of 3 simulate: {robots} robots drive {path_m:g} m each; their starts are unknown")
    recordings = record_fleet(fleet, output / RECORDINGS, console)
    sources = [open_source(place) for place in recordings]
    print_line(console, "2 of 3 map each robot, recognise places, fuse the maps")
    map_sources(sources, MissionConfig(seed=seed), MissionInputs(), output / RUN, console, force=True)
    print_line(console, "3 of 3 evaluate: compare with the truth")
    report_fleet(output / RUN, output / RECORDINGS, output / TABLE, console)
    typer.echo(f"{time.perf_counter() - began:.0f} s in all")
    for content, name in (("run folder", RUN), ("map", f"{RUN}/map.png"), ("all numbers", TABLE)):
        typer.echo(f"{content}: {output / name}")


def _prepare(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
        if any(output.iterdir()) and not (output / ABOUT).is_file():
            raise InputError(
                f"{output}: holds something that is not a demo; remove it, or name another folder with --output"
            )
        names = (RECORDINGS, RUN, TABLE)
        (output / ABOUT).write_text(
            f"Written by `fcslam demo`, which replaces {', '.join(names)} here when it runs again.\n", encoding="utf-8"
        )
        for place in (output / name for name in names):
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be used as the output folder ({error})") from error
