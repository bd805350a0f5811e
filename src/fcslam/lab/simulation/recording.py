"""Writes the recordings of a simulated fleet. A resumed simulation gives the same bytes as an uninterrupted one."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml

import fcslam
from fcslam.config import dump, parse_yaml
from fcslam.errors import OutputError
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings
from fcslam.records import GroundTruth, RecordedItem
from fcslam.sources import RecordingWriter
from fcslam.sources.recording.layout import META
from fcslam.storage.files import write_file
from fcslam.untrusted import read_text

SETTINGS = "simulation.yaml"
"""File with the settings of the fleet in a folder, which determine all its recordings."""

Watch = Callable[[Iterator[RecordedItem]], Iterator[RecordedItem]]


def prepare_fleet_folder(folder: Path, settings: SimulationSettings, seed: int, resume: bool) -> None:
    """Make the fleet's folder and write its settings; with ``resume`` it may hold an interrupted simulation of them.

    Raises:
        OutputError: the folder holds something else, or cannot be written.
    """
    text = f"# What fcslam simulated here.\nfcslam: {fcslam.__version__}\nseed: {seed}\n{dump(settings)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / SETTINGS).is_file() and resume:
            _check_same(folder / SETTINGS, yaml.safe_load(text))
            return
        if any(path.name != f".{SETTINGS}.partial" for path in folder.iterdir()):
            hint = ", or go on with it by --resume" if (folder / SETTINGS).is_file() else ""
            raise OutputError(f"{folder}: is not empty; choose another place{hint}")
        write_file(folder / SETTINGS, text)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be used as the output folder ({error})") from error


def record_robot(robot: SimulatedRobot, folder: Path, watch: Watch = iter, resume: bool = False) -> None:
    """Write the robot's recording to ``folder``; with ``resume``, continue after the records that it holds already.

    ``watch`` receives the records and passes them on; the recording ends when it ends.

    Raises:
        SimulationError: MuJoCo or, with a camera, a GL library is missing.
        OutputError: something is in the way, or cannot be written.
        SourceError: what is there is no recording that can go on.
    """
    with _writer(robot, folder, resume) as writer:
        counts = writer.counts
        known = counts.ground_truth
        with closing(robot.items(counts.scans, counts.images, counts.odometry)) as items:
            for item in watch(items):
                if isinstance(item, GroundTruth) and known:
                    known -= 1
                else:
                    writer.write(item)


def _writer(robot: SimulatedRobot, folder: Path, resume: bool) -> RecordingWriter:
    if resume and (folder / META).is_file():
        writer = RecordingWriter.resume(folder)
        if writer.is_gapless:
            return writer
        # After a power cut, records before existing ones may be missing, so the order cannot be restored.
        writer.close()
    if resume and folder.exists():
        shutil.rmtree(folder)
    return RecordingWriter.create(folder, robot.lasers, robot.camera)


def _check_same(path: Path, wanted: dict[str, Any]) -> None:
    try:
        found = parse_yaml(read_text(path))
    except ValueError as error:
        raise OutputError(f"{path}: cannot be read, so nothing can go on here; choose another place") from error
    if found != wanted:
        raise OutputError(f"{path}: {_difference(found, wanted)}; give what was given before, or choose another place")


def _difference(found: Any, wanted: Any, key: str = "") -> str:
    """The first key that differs, in words."""
    if not isinstance(found, dict) or not isinstance(wanted, dict):
        return f"{key or 'the fleet'} was {found} and is now {wanted}"
    name = next(name for name in {**wanted, **found} if found.get(name) != wanted.get(name))
    return _difference(found.get(name), wanted.get(name), f"{key}.{name}" if key else name)
