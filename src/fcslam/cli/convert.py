"""`fcslam convert`: a recording in another format."""

import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.recordings import (
    CameraTopic,
    LaserPose,
    OdomTopic,
    ScanTopic,
    bag_options,
    open_recording,
    show_faults,
    show_notes,
)

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.records import SensorRecord
    from fcslam.sources import Source, Survey

_CARMEN = re.compile(r"\.(clf|log)(\.(gz|xz|bz2))?$")
_RECORDING = ".fcslam"
_FOLDER_MARKS = {"": "metadata.yaml", _RECORDING: "meta.yaml"}
"""What a folder holds that may be replaced."""


def convert(
    recording: Annotated[str, typer.Argument(metavar="RECORDING", help="The recording to read.")],
    output: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT",
            help="The file to write: .clf or .log (.gz, .xz, .bz2) is a CARMEN log, .bag a ROS 1 bag, .mcap and .db3 "
            "ROS 2 bags, .fcslam a recording folder; without a suffix a ROS 2 bag folder.",
        ),
    ],
    *,
    scan_topic: ScanTopic = None,
    odom_topic: OdomTopic = None,
    camera_topic: CameraTopic = None,
    laser_pose: LaserPose = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace what is there already.")] = False,
) -> None:
    """Write the scans, the odometry and the images of a recording in another format, told by OUTPUT's suffix."""
    from rich.console import Console

    console = Console(stderr=True)
    source = open_recording(recording, bag_options(scan_topic, odom_topic, camera_topic, laser_pose))
    _prepare(output, force)
    survey = source.survey()
    show_notes(console, survey.notes)
    if survey.camera is not None and _CARMEN.search(output.name):
        show_notes(console, [f"{output}: a CARMEN log has no place for images, they are left out"])
    _write(output, survey, _watched(source, survey.scan_count, console))
    show_faults(console, [source])
    Console().print(f"{survey.scan_count} scans: {output}", highlight=False, markup=False, soft_wrap=True)


def _prepare(output: Path, force: bool) -> None:
    """Check, before the work, that ``output`` can be written; its parents are made."""
    from fcslam.errors import OutputError
    from fcslam.sources import BAG_SUFFIXES

    if not (_CARMEN.search(output.name) or output.suffix in (*BAG_SUFFIXES, _RECORDING)):
        raise OutputError(
            f"{output}: unknown format; end it in .clf (.gz, .xz, .bz2), .bag, .mcap, .db3, .fcslam, or in nothing"
        )
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error}); choose another place") from error
    if output.exists() and not force:
        raise OutputError(f"{output}: exists; choose another name or give --force to replace it")
    mark = _FOLDER_MARKS.get(output.suffix)
    if output.is_dir() and (mark is None or not (output / mark).is_file()):
        raise OutputError(f"{output}: is a folder and no recording; choose another name")


def _write(output: Path, survey: "Survey", records: "Iterable[SensorRecord]") -> None:
    """Write beside ``output`` and put it in its place when it is complete."""
    from fcslam.errors import OutputError
    from fcslam.sources import write_bag, write_carmen, write_recording

    try:
        with TemporaryDirectory(prefix=".", dir=output.parent) as staging:
            whole = Path(staging, output.name)
            if output.suffix == _RECORDING:
                write_recording(whole, survey.laser, survey.camera, records)
            else:
                (write_carmen if _CARMEN.search(output.name) else write_bag)(whole, records)
            if output.is_dir():
                shutil.rmtree(output)
            whole.replace(output)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error}); choose another place") from error


def _watched(source: "Source", total: int, console: "Console") -> "Iterator[SensorRecord]":
    """The recording's records, with a progress display."""
    from rich.progress import Progress

    from fcslam.records import LaserScan

    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("converting", total=total)
        for record in source.records():
            yield record
            if isinstance(record, LaserScan):
                bar.advance(task)
