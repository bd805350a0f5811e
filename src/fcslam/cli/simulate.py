"""`fcslam simulate`: recordings of a fleet that drives in a building of our own making."""

import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.simulation.options import Building, Lighting

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from fcslam.records import RecordedItem
    from fcslam.simulation.simulated_fleet import SimulatedFleet


def simulate(
    *,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the recordings; new or empty, but for --resume."),
    ],
    robots: Annotated[int, typer.Option(min=1, max=100, help="How many robots drive.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws another building.")] = 1,
    building: Annotated[Building, typer.Option(help="What kind of building.")] = Building.DEFAULT,
    path_length: Annotated[float, typer.Option(min=1.0, max=10_000.0, help="Metres that each robot drives.")] = 60.0,
    lighting: Annotated[
        list[Lighting] | None,
        typer.Option(help="What the first robot sees by, the second ...; in turn if given fewer times. [default: day]"),
    ] = None,
    moved_furniture: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of the rooms' furniture that moves between robots.")
    ] = 0.0,
    no_camera: Annotated[bool, typer.Option("--no-camera", help="LiDAR only; needs no GL library.")] = False,
    bag: Annotated[bool, typer.Option("--bag", help="Write a ROS 2 bag (.mcap) of each robot as well.")] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an interrupted simulation of the same settings.")
    ] = False,
) -> None:
    """Draw a building, drive robots through it, record what their LiDARs and cameras see and where they really were."""
    from rich.console import Console

    from fcslam.errors import OutputError
    from fcslam.simulation.recording import prepare_fleet_folder
    from fcslam.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet

    settings = SimulationSettings(
        building=building,
        robots=robots,
        path_length_m=path_length,
        lighting=tuple(lighting or (Lighting.DAY,)),
        moved_furniture=moved_furniture,
        camera=None if no_camera else CameraSettings(),
    )
    fleet = simulate_fleet(settings, seed)
    prepare_fleet_folder(output, settings, seed, resume)
    try:
        record_fleet(fleet, output, seed, bag, Console(stderr=True), resume)
    except OutputError as error:
        raise OutputError(f"{error}; with --resume the same command goes on") from error


def record_fleet(
    fleet: "SimulatedFleet", output: Path, seed: int, bag: bool, console: "Console", resume: bool = False
) -> list[Path]:
    """Write one recording a robot into the folder ``output``, the truth beside them; returns the recordings.

    With ``resume`` recordings that are there already go on.

    Raises:
        SimulationError: MuJoCo or a GL library is missing.
        OutputError: something cannot be written.
    """
    import numpy as np

    from fcslam.errors import OutputError
    from fcslam.simulation.ground_truth import write_ground_truth
    from fcslam.simulation.recording import record_robot
    from fcslam.sources import open_source, write_bag

    began = time.perf_counter()
    recordings = [output / robot.name for robot in fleet.robots]
    with _progress(fleet, console) as watch, ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [
            pool.submit(record_robot, robot, place, watch, resume)
            for robot, place in zip(fleet.robots, recordings, strict=True)
        ]
        try:
            for job in jobs:
                job.result()
        finally:
            watch.stop()
    try:
        write_ground_truth(fleet, output, np.random.default_rng(seed))
        if bag:
            for place in recordings:
                # A bag is whole or not there.
                if not place.with_suffix(".mcap").exists():
                    write_bag(place.with_suffix(".mcap"), open_source(place).records())
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error}); make room or choose another place") from error
    _report(fleet, recordings, time.perf_counter() - began, console)
    return recordings


class _Watch:
    """Lets robots' records through while somebody looks on, until it is stopped. Each record comes with its truth."""

    def __init__(self, bar: "Progress", task: "TaskID") -> None:
        self._bar, self._task = bar, task
        self._stopped = False

    def stop(self) -> None:
        """End every robot's recording at its next record."""
        self._stopped = True

    def __call__(self, items: "Iterator[RecordedItem]") -> "Iterator[RecordedItem]":
        from fcslam.records import GroundTruth

        for item in items:
            if self._stopped:
                return
            yield item
            if isinstance(item, GroundTruth):
                self._bar.advance(self._task)


@contextmanager
def _progress(fleet: "SimulatedFleet", console: "Console") -> "Iterator[_Watch]":
    """A live line over all robots' scans and images."""
    from rich.progress import Progress

    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        total = sum(len(robot.stamps) + len(robot.image_stamps) for robot in fleet.robots)
        yield _Watch(bar, bar.add_task("simulating", total=total))


def _report(fleet: "SimulatedFleet", recordings: list[Path], elapsed_s: float, console: "Console") -> None:
    for robot, place in zip(fleet.robots, recordings, strict=True):
        typer.echo(f"{place}: {len(robot.stamps)} scans, {len(robot.image_stamps)} images, {robot.duration_s:.0f} s")
    speed = max(robot.duration_s for robot in fleet.robots) / elapsed_s
    console.print(f"{elapsed_s:.1f} s, {speed:.1f} x real time", highlight=False)
