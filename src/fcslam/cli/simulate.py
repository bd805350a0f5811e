"""`fcslam tools simulate`: recordings of a fleet that drives in a simulated building."""

import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.options import BuildingSeed, NoCamera, PathLength, chosen_settings, output_option
from fcslam.cli.output import ELSEWHERE, RECORDINGS, new_folder, notices, print_line
from fcslam.errors import writing
from fcslam.lab.simulation.options import Building, Lighting, OdometryKind, Scanner

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.lab.simulation.simulated_fleet import SimulatedFleet
    from fcslam.records import SensorRecord


def simulate(
    *,
    output: Annotated[
        Path | None,
        output_option("Folder for the recordings. It must be new or empty.", RECORDINGS),
    ] = None,
    robots: Annotated[int | None, typer.Option(min=1, max=100, help="Number of robots.", show_default="3")] = None,
    seed: BuildingSeed = 1,
    building: Annotated[Building | None, typer.Option(help="Kind of building.", show_default="default")] = None,
    path_length: PathLength = None,
    lighting: Annotated[
        list[Lighting] | None,
        typer.Option(
            help="Light for the first robot; repeat it for the second and so on. Further robots take them in turn.",
            show_default="day",
        ),
    ] = None,
    scanner: Annotated[
        Scanner | None,
        typer.Option(
            help="Scanner of each robot. One with the name of a product spins and measures each beam at its own time.",
            show_default="instant",
        ),
    ] = None,
    odometry: Annotated[
        OdometryKind | None,
        typer.Option(help="Kind of wheel odometry, or what is wrong with it.", show_default="default"),
    ] = None,
    no_camera: NoCamera = False,
    config: Annotated[
        list[str] | None,
        typer.Option(
            "--config",
            "-c",
            metavar="FILE|KEY=VALUE",
            help="Settings of the simulation (YAML), or one of its keys, such as moved_furniture=0.5, over those of "
            "--scanner. Can be repeated. Each simulation writes its own to simulation.yaml.",
        ),
    ] = None,
) -> None:
    """Simulate robots that drive through a building, and record their LiDARs, cameras and true poses."""
    from fcslam.lab.simulation.noise import SCANNERS
    from fcslam.lab.simulation.recording import prepare_fleet_folder
    from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet

    settings = SimulationSettings(lidar=SCANNERS[scanner or Scanner.INSTANT])
    settings = chosen_settings(settings, config)
    given = {
        "robots": robots,
        "building": building,
        "path_length_m": path_length,
        "lighting": tuple(lighting) if lighting else None,
        "odometry": odometry,
    }
    settings = settings.model_copy(update={key: value for key, value in given.items() if value is not None})
    if no_camera:
        settings = settings.model_copy(update={"camera": None})
    fleet = simulate_fleet(settings, seed)
    output = output or new_folder(RECORDINGS)
    prepare_fleet_folder(output, settings, seed)
    record_fleet(fleet, output, notices())


def record_fleet(fleet: "SimulatedFleet", output: Path, console: "Console") -> list[Path]:
    """Write a recording of each robot and the truth into the folder ``output``; returns the recordings."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.simulation.recording import record_robot, write_ground_truth
    from fcslam.records import Odometry

    began = time.perf_counter()
    recordings = [output / robot.name for robot in fleet.robots]
    total = sum(len(robot.stamps) + len(robot.image_stamps) for robot in fleet.robots)
    with ProgressDisplay(console) as display:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            advance, stopped = display.start("simulating", total), Event()

            def watch(items: "Iterator[SensorRecord]") -> "Iterator[SensorRecord]":
                """Count scans and images, until all robots are stopped."""
                for item in items:
                    if stopped.is_set():
                        return
                    yield item
                    if not isinstance(item, Odometry):
                        advance()

            jobs = [
                pool.submit(record_robot, robot, place, watch)
                for robot, place in zip(fleet.robots, recordings, strict=True)
            ]
            try:
                for job in jobs:
                    job.result()
            finally:
                stopped.set()
        display.start("writing")
        with writing(output, f"make room or {ELSEWHERE}"):
            write_ground_truth(fleet, output)
    _report(fleet, recordings, time.perf_counter() - began, console)
    return recordings


def _report(fleet: "SimulatedFleet", recordings: list[Path], elapsed_s: float, console: "Console") -> None:
    for robot, place in zip(fleet.robots, recordings, strict=True):
        typer.echo(f"{place}: {len(robot.stamps)} scans, {len(robot.image_stamps)} images, {robot.duration_s:.0f} s")
    speed = max(robot.duration_s for robot in fleet.robots) / elapsed_s
    print_line(console, f"{elapsed_s:.1f} s, {speed:.1f} x real time")
