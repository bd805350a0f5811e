"""Writes the recordings of a simulated fleet."""

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

import fcslam
from fcslam.config import dump
from fcslam.errors import OutputError
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings
from fcslam.records import RecordedItem
from fcslam.sources import RecordingWriter
from fcslam.storage.files import write_file

SETTINGS: Final = "simulation.yaml"
"""File with the settings of the fleet in a folder, which determine all its recordings."""

Watch = Callable[[Iterator[RecordedItem]], Iterator[RecordedItem]]


def prepare_fleet_folder(folder: Path, settings: SimulationSettings, seed: int) -> None:
    """Make the fleet's folder and write its settings.

    Raises:
        OutputError: the folder holds something else, or cannot be written.
    """
    text = f"# What fcslam simulated here.\nfcslam: {fcslam.__version__}\nseed: {seed}\n{dump(settings)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise OutputError(f"{folder}: is not empty; choose another place")
        write_file(folder / SETTINGS, text)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be used as the output folder ({error})") from error


def record_robot(robot: SimulatedRobot, folder: Path, watch: Watch = iter) -> None:
    """Write the robot's recording to ``folder``.

    ``watch`` receives the records and passes them on; the recording ends when it ends.

    Raises:
        SimulationError: MuJoCo or, with a camera, a GL library is missing.
        OutputError: something is in the way, or cannot be written.
    """
    with RecordingWriter.create(folder, robot.lasers, robot.camera) as writer, closing(robot.items()) as items:
        for item in watch(items):
            writer.write(item)
