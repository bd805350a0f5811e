"""`fcslam record`: write the sensors of a live robot, or of another recording, into a file."""

import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Timer
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.inputs import is_live, live_source, open_recording, print_faults
from fcslam.cli.live import stopping
from fcslam.cli.options import Force, Quiet, Sensors
from fcslam.cli.output import ELSEWHERE, notices, print_line
from fcslam.errors import InputError, writing

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.inputs import LiveSource
    from fcslam.records import SensorRecord


def record(
    source: Annotated[
        str,
        typer.Argument(
            metavar="ADDRESS|LOG",
            help="A live robot: ros2:/NAMESPACE or zenoh:/NAMESPACE; ros2:/ has none. Or a recording, to write it "
            "as a bag.",
        ),
    ],
    *,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Bag to write. A live robot: .mcap. A recording: .mcap or .db3 a ROS 2 bag, .bag a ROS 1 bag, no "
            "suffix a ROS 2 bag folder.",
        ),
    ],
    duration: Annotated[
        float | None,
        typer.Option(min=0.1, help="Time to record a live robot, in seconds.", show_default="until Ctrl-C"),
    ] = None,
    sensors: Sensors = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Record the sensors of a live robot: everything that `fcslam map` needs. Or convert a recording to a bag."""
    console = notices(quiet)
    if is_live(source):
        _record(live_source(source, sensors), output, duration, force, console)
    else:
        if duration is not None:
            raise InputError(f"--duration is the time to record a live robot; {source} is a recording")
        _convert(source, output, sensors, force, console)


def _record(live: "LiveSource", output: Path, duration: float | None, force: bool, console: "Console") -> None:
    from fcslam.ros.node import await_sensors, open_network
    from fcslam.ros.record import record as record_messages

    place = live.address
    if output.suffix != ".mcap":
        raise InputError(f"{output}: a recording of a live robot is a .mcap file; choose such a name")
    _prepare(output, force)
    stop = Event()
    with closing(open_network(place.network)) as network:
        found = await_sensors(network, place.namespace, live.options, live.parameters.topic_timeout)
        print_line(console, f"records {', '.join(found.kinds)}; Ctrl-C ends the recording")
        timer = Timer(duration or 0.0, stop.set)
        timer.daemon = True
        with stopping(stop.set):
            if duration is not None:
                timer.start()
            counts = record_messages(network, found, output, stop, lambda line: print_line(console, line))
        timer.cancel()
    listed = ", ".join(f"{count} of {topic}" for topic, count in sorted(counts.items())) or "no messages"
    typer.echo(f"{listed}: {output}")


def _convert(log: str, output: Path, sensors: list[str] | None, force: bool, console: "Console") -> None:
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.records import LaserScan
    from fcslam.sources import write_bag

    _prepare(output, force)
    source, survey = open_recording(log, sensors, console)

    def records() -> "Iterator[SensorRecord]":
        advance = display.start("converting", survey.scan_count)
        for record in source.records():
            yield record
            if isinstance(record, LaserScan):
                advance()

    with (
        writing(output, ELSEWHERE),
        ProgressDisplay(console) as display,
        TemporaryDirectory(prefix=".", dir=output.parent) as staging,
    ):
        whole = Path(staging, output.name)
        write_bag(whole, records())
        if output.is_dir():
            shutil.rmtree(output)
        whole.replace(output)
    print_faults(console, {source.name: source.faults})
    typer.echo(f"{survey.scan_count} scans: {output}")


def _prepare(output: Path, force: bool) -> None:
    """Check before the work that ``output`` can be written, and create its parents."""
    with writing(output, ELSEWHERE):
        output.parent.mkdir(parents=True, exist_ok=True)
        if output.exists() and not force:
            raise InputError(f"{output}: exists; choose another name or give --force to replace it")
        if output.is_dir() and (output.suffix or not (output / "metadata.yaml").is_file()):
            raise InputError(f"{output}: is a folder, not a recording; choose another name")
