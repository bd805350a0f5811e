"""`fcslam robot`: one robot of a mission whose cloud is elsewhere."""

import signal
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
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

    from fcslam.robot.agent import Agent, AgentProgress, AgentWatch
    from fcslam.robot.frontend import RobotConfig
    from fcslam.robot.outbox import Outbox
    from fcslam.sources import Source, Survey


def _explain_traffic(wanted: bool) -> None:
    if not wanted:
        return
    from rich.console import Console
    from rich.table import Table

    from fcslam.wire.disclosure import disclosures

    console = Console()
    for message in disclosures():
        table = Table("field", "type", "what it could reveal", title=f"{message.name}: {message.direction}")
        table.title_justify = "left"
        for field in message.fields:
            table.add_row(field.name, field.type, field.reveals)
        console.print(table)
    console.print(
        "A message has no other field; unknown ones are refused. The network besides sees the robot's address and when "
        "it sends, and without TLS everything; a token and a random number tell the cloud which robot speaks.",
        soft_wrap=True,
    )
    raise typer.Exit


_NETWORK = "Network"

TokenFile = Annotated[Path | None, typer.Option(help="File with the robot's token.", rich_help_panel=_NETWORK)]
Ca = Annotated[
    Path | None,
    typer.Option(
        help="PEM file of who signed the cloud's certificate; the system's if not given.", rich_help_panel=_NETWORK
    ),
]
Certificate = Annotated[
    Path | None,
    typer.Option(help="PEM file of the robot's certificate, shown instead of a token.", rich_help_panel=_NETWORK),
]
Key = Annotated[Path | None, typer.Option(help="PEM file of its private key.", rich_help_panel=_NETWORK)]
BudgetKbps = Annotated[
    float | None,
    typer.Option(
        "--budget-kBps", min=0.1, rich_help_panel=_NETWORK,
        help="Most to send per second of the recording, in kB: places get what is left.",
    ),
]  # fmt: skip
OutboxMb = Annotated[
    float,
    typer.Option(
        min=0.1, help="Most that waits on disk; at three quarters places are left out.", rich_help_panel=_NETWORK
    ),
]
ExplainTraffic = Annotated[
    bool,
    typer.Option(
        "--explain-traffic", callback=_explain_traffic, is_eager=True, rich_help_panel=_NETWORK,
        help="List every message, its fields and what they could reveal, and exit.",
    ),
]  # fmt: skip


def robot(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="The robot's recording; NAME=LOG names it.")],
    *,
    server: Annotated[str, typer.Option(metavar="URL", help="The cloud, as https://cloud.example:8443.")],
    state: Annotated[
        Path, typer.Option(help="Folder for what the cloud has not confirmed yet; one a robot, kept between starts.")
    ],
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the recording if it was interrupted; else start anew.")
    ] = False,
    name: Annotated[str | None, typer.Option(help="The robot's name; the file's if not given.")] = None,
    speed: Annotated[
        str, typer.Option(metavar="FACTOR", help="Play so many times as fast as it was recorded; max: no waiting.")
    ] = "max",
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Configuration file; see `fcslam config dump`.")
    ] = None,
    token_file: TokenFile = None,
    ca: Ca = None,
    certificate: Certificate = None,
    key: Key = None,
    budget_kbps: BudgetKbps = None,
    outbox_mb: OutboxMb = 256.0,
    scan_topic: ScanTopic = None,
    odom_topic: OdomTopic = None,
    camera_topic: CameraTopic = None,
    laser_pose: LaserPose = None,
    _explain: ExplainTraffic = False,
) -> None:
    """Be one robot: map a recording, send places and keyscans to the cloud, through outages and restarts."""
    from rich.console import Console

    from fcslam.robot.agent import PlaybackPace

    pace = PlaybackPace(_speed(speed), time.monotonic, time.sleep)
    settings = _settings(config)
    argument = source if name is None else f"{name}={source}"
    recording = open_recording(argument, bag_options(scan_topic, odom_topic, camera_topic, laser_pose))
    _check_name(recording.name)
    token, own = _token(token_file), _own(certificate, key)
    survey = recording.survey()
    console = Console(stderr=True)
    show_notes(console, survey.notes)
    with _agent(recording.name, settings, server, state, token, ca, own, outbox_mb, budget_kbps) as (agent, outbox):
        known = outbox.begin(_fingerprint(recording.name, survey, settings, budget_kbps), resume)
        try:
            with _interruptible(), _progress(console, survey.scan_count) as watch:
                agent.run(recording.records(), known, pace, watch)
        except KeyboardInterrupt:
            left = outbox.waiting
            console.print(
                f"{left.packets} packets ({left.bytes / 1e3:.0f} kB) wait in {state}; --resume goes on", soft_wrap=True
            )
            raise
        _report(recording, agent, state, server)


@contextmanager
def _agent(
    name: str,
    settings: "RobotConfig",
    server: str,
    state: Path,
    token: str | None,
    ca: Path | None,
    own: tuple[Path, Path] | None,
    outbox_mb: float,
    budget_kbps: float | None,
) -> "Iterator[tuple[Agent, Outbox]]":
    """The robot, and its outbox in the state folder."""
    import numpy as np

    from fcslam.errors import StateError
    from fcslam.robot.agent import Agent
    from fcslam.robot.budget import Budget
    from fcslam.robot.frontend import RobotFrontend
    from fcslam.robot.outbox import Outbox
    from fcslam.wire.http_transport import HttpTransport

    try:
        state.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StateError(f"{state}: cannot be made ({error.strerror}); give another --state") from error
    frontend = RobotFrontend(name, settings)
    # Robots must not try again in step, so this is not the mission's seed.
    rng = np.random.default_rng()
    budget = None if budget_kbps is None else Budget(1e3 * budget_kbps)
    with (
        closing(Outbox(state / "outbox.sqlite", name, int(outbox_mb * 1e6))) as outbox,
        closing(HttpTransport(server, name, outbox.agent, token, ca, own)) as transport,
    ):
        yield Agent(frontend, outbox, transport, state, rng, time.monotonic, time.sleep, budget), outbox


def _settings(config: Path | None) -> "RobotConfig":
    from fcslam.config import load
    from fcslam.mission import MissionConfig

    return (MissionConfig() if config is None else load(MissionConfig, config)).robot


def _speed(text: str) -> float | None:
    """None: as fast as possible."""
    from fcslam.errors import InputError

    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed < float("inf"):
        raise InputError(f"--speed {text!r} is no speed; give a factor above 0, or max")
    return speed


def _check_name(name: str) -> None:
    from fcslam.errors import PacketError, SourceError
    from fcslam.wire.checks import check_name

    try:
        check_name(name, "robot")
    except PacketError as error:
        raise SourceError(f"{error}; name it by --name") from error
    stem, plus, number = name.rpartition("+")
    if plus and number.isdigit():
        raise SourceError(f"robot: {name!r} is how a later start of {stem!r} is called; name it otherwise by --name")


def _token(path: Path | None) -> str | None:
    from fcslam.errors import InputError

    if path is None:
        return None
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no token can be read ({error}); give the file that the cloud's owner made"
        ) from error
    if not token or not token.isprintable() or " " in token:
        raise InputError(f"{path}: holds no token; it should be one word")
    return token


def _own(certificate: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    from fcslam.errors import InputError

    if (certificate is None) != (key is None):
        raise InputError("--certificate and --key belong together; give both or none")
    return None if certificate is None or key is None else (certificate, key)


def _fingerprint(name: str, survey: "Survey", settings: "RobotConfig", budget_kbps: float | None) -> str:
    """What must be the same for the same packets; digests of the packets find out the rest."""
    import hashlib

    import fcslam
    from fcslam.config import dump

    length = survey.scan_count, survey.duration_s, survey.path_length_m
    told = (fcslam.__version__, name, *length, survey.laser, budget_kbps)
    return hashlib.sha256(f"{told} {dump(settings)}".encode()).hexdigest()


@contextmanager
def _interruptible() -> Iterator[None]:
    """A service manager's SIGTERM is as good as Ctrl-C."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _progress(console: "Console", total: int) -> "Iterator[AgentWatch]":
    """A live line on a terminal; what happens to the connection is said everywhere."""
    from rich import progress

    columns = [
        progress.TextColumn("{task.fields[stage]}"), progress.BarColumn(bar_width=24), progress.MofNCompleteColumn(),
        progress.TextColumn("scans, {task.fields[what]}"),
    ]  # fmt: skip
    trouble: str | None = "connecting"
    notices: tuple[str, ...] = ()
    whereabouts, times_lost = "mapping", 0
    with progress.Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, stage="mapping", what="")

        def watch(now: "AgentProgress") -> None:
            nonlocal trouble, notices, whereabouts, times_lost
            lines = [now.trouble or "connected"] * (now.trouble != trouble)
            if (now.localization, now.times_lost) != (whereabouts, times_lost):
                lines.append(_found(now, times_lost))
            whereabouts, times_lost = now.localization, now.times_lost
            for line in [*lines, *(notice for notice in now.notices if notice not in notices)]:
                console.print(line, highlight=False, markup=False, soft_wrap=True)
            trouble, notices = now.trouble, now.notices
            stage = "catching up" if now.catching_up else str(now.localization) if now.scans < total else "sending"
            bar.update(task, completed=now.scans, stage=stage, what=_what(now))

        yield watch


def _found(now: "AgentProgress", before: int) -> str:
    """What a robot that was lost knows of its place; ``before``: how often it was when that was last said."""
    if now.quality > 0.0:
        return f"relocalised in map {now.map_index}, quality {now.quality:.2f}"
    if now.times_lost > before:
        return "lost: this is not the place of before; a new session begins here"
    return "not relocalised: nobody bears out where it is"


def _what(now: "AgentProgress") -> str:
    told = [
        f"{now.keyscans} keyscans",
        f"{now.sent_bytes / 1e3:.0f} kB sent",
        f"{now.confirmed} packets confirmed",
        f"{now.waiting.packets} waiting",
        "alone"
        if now.map_index is None
        else f"map {now.map_index}, quality {now.quality:.2f}, corrected {now.correction_age_s or 0.0:.0f} s ago",
    ]
    told += [f"{now.left_out} places left out"] if now.left_out else []
    told += [f"{now.refused} refused"] if now.refused else []
    return ", ".join([*told, "offline" if now.trouble else "online"])


def _report(recording: "Source", agent: "Agent", state: Path, server: str) -> None:
    from rich.console import Console

    from fcslam.runs import write_tum

    now = agent.progress()
    show_faults(Console(stderr=True), [recording])
    console = Console()
    console.print(
        f"{now.scans} scans, {now.keyscans} keyscans; {server} has all of it ({now.sent_bytes / 1e3:.0f} kB sent)",
        highlight=False, soft_wrap=True,
    )  # fmt: skip
    if now.left_out:
        console.print(f"{now.left_out} places were left out: too much waited, or the budget was spent", highlight=False)
    if now.refused:
        console.print(f"{now.refused} packets were refused: {state / 'refused'}", highlight=False, soft_wrap=True)
    if now.times_lost:
        lost = f"lost {now.times_lost} times" if now.times_lost > 1 else "lost once"
        console.print(f"{lost}; {_found(now, now.times_lost)}", highlight=False)
    trajectory = agent.trajectory()
    if trajectory is not None:
        write_tum(state / "trajectory.tum", *trajectory)
        console.print(f"trajectory in map {now.map_index}: {state / 'trajectory.tum'}", highlight=False, soft_wrap=True)
