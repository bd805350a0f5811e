"""`fcslam robot`: one robot of a mission, which sends to a cloud service."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.learning_options import LearnConfig, RobotLearning
from fcslam.cli.mission_options import ConfigFile, PresetName, mission_config
from fcslam.cli.options import Quiet, output_option
from fcslam.cli.output import RUNS, answers, notices, print_line
from fcslam.cli.recordings import (
    BaseFrame,
    CameraTopic,
    CloudHeights,
    InitialPose,
    LaserPose,
    OdomFrame,
    OdomTopic,
    ScanTopic,
    bag_options,
    open_recording,
    pose,
    print_faults,
    print_notes,
)
from fcslam.cli.ros_options import DomainId, RosParameters, UseSimTime, node_parameters
from fcslam.cli.warm_up import compiled

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.federated.learning_beside import RobotLearningPlan
    from fcslam.live.records import RobotStatus
    from fcslam.live.robot import Robot
    from fcslam.robot.frontend import RobotConfig
    from fcslam.sources import Source, Survey


def _explain_traffic(wanted: bool) -> None:
    if not wanted:
        return
    from rich.table import Table

    from fcslam.wire.disclosure import disclosures

    console = answers()
    for message in disclosures():
        table = Table("field", "type", "what it could reveal", title=f"{message.name}: {message.direction}")
        table.title_justify = "left"
        for field in message.fields:
            table.add_row(field.name, field.type, field.reveals)
        console.print(table)
    console.print(
        "A message has no other field, and unknown fields are refused. The network sees the robot's address and the "
        "times of its requests, and without TLS also their content. A token and a random number identify the robot.",
        soft_wrap=True,
    )
    raise typer.Exit


_NETWORK, _LEARNING = "Network", "Learning"

Localize = Annotated[
    Path | None,
    typer.Option(
        metavar="MAP",
        help="Find the live robot in a finished map, which does not change: a run folder, a mission file, or the YAML "
        "file of a ROS map. With --server, MAP is a folder for a copy of the cloud's maps; the robot uses an earlier "
        "copy if it cannot reach the cloud.",
    ),
]

TokenFile = Annotated[Path | None, typer.Option(help="File with the robot's token.", rich_help_panel=_NETWORK)]
Ca = Annotated[
    Path | None,
    typer.Option(
        help="Certificate of the authority that signed the cloud's certificate (PEM).",
        show_default="the authorities of this system",
        rich_help_panel=_NETWORK,
    ),
]
Certificate = Annotated[
    Path | None,
    typer.Option(help="The robot's certificate (PEM), which replaces the token.", rich_help_panel=_NETWORK),
]
Key = Annotated[Path | None, typer.Option(help="Private key of --certificate (PEM).", rich_help_panel=_NETWORK)]
BudgetKbps = Annotated[
    float | None,
    typer.Option(
        "--budget-kBps", min=0.1, rich_help_panel=_NETWORK,
        help="Limit of the uplink, in kB per second of the recording. Keyscans and constraints are always sent; places "
        "are sent with fewer descriptors or left out.",
    ),
]  # fmt: skip
OutboxMb = Annotated[
    float,
    typer.Option(
        min=0.1, rich_help_panel=_NETWORK,
        help="Limit of the packets that wait on disk, in MB. Above three quarters, places are left out.",
    ),
]  # fmt: skip
ExplainTraffic = Annotated[
    bool,
    typer.Option(
        "--explain-traffic", callback=_explain_traffic, is_eager=True, rich_help_panel=_NETWORK,
        help="List every message, its fields and what they could reveal, and exit.",
    ),
]  # fmt: skip


def robot(
    source: Annotated[
        str,
        typer.Argument(
            metavar="LOG",
            help="The robot's recording, which names the robot; NAME=LOG gives another name. Or a live robot: "
            "ros2:/NAMESPACE, zenoh:/NAMESPACE or ros1:/NAMESPACE, without a namespace ros2:/.",
        ),
    ],
    *,
    server: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Address of the cloud, as in https://cloud.example:8443, or those of its instances with commas "
            "between them. A live robot without one maps alone.",
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(help="Folder of the packets that the cloud has not confirmed. Each robot needs its own; keep it."),
    ] = None,
    output: Annotated[
        Path | None,
        output_option("Run folder of a live robot, with its own map.", RUNS),
    ] = None,
    localize: Localize = None,
    initial_pose: InitialPose = None,
    floor: Annotated[
        str, typer.Option(help="Floor of the building. Places of different floors are never compared.")
    ] = "",
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted recording instead of starting it again.")
    ] = False,
    name: Annotated[str | None, typer.Option(help="Name of the robot.", show_default="that of the file")] = None,
    speed: Annotated[
        str,
        typer.Option(
            metavar="FACTOR", help="Playback speed as a multiple of real time; max plays as fast as possible."
        ),
    ] = "max",
    config: ConfigFile = None,
    preset: PresetName = None,
    token_file: TokenFile = None,
    ca: Ca = None,
    certificate: Certificate = None,
    key: Key = None,
    budget_kbps: BudgetKbps = None,
    outbox_mb: OutboxMb = 256.0,
    scan_topic: ScanTopic = None,
    odom_topic: OdomTopic = None,
    odom_frame: OdomFrame = None,
    base_frame: BaseFrame = None,
    camera_topic: CameraTopic = None,
    laser_pose: LaserPose = None,
    cloud_band: CloudHeights = None,
    domain: DomainId = None,
    ros_parameters: RosParameters = None,
    use_sim_time: UseSimTime = False,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            rich_help_panel=_LEARNING,
            help="Train the detector with the fleet on what the camera saw again: after a recording, and while a live "
            "robot stands still. No image leaves.",
        ),
    ] = False,
    learn_config: LearnConfig = None,
    quiet: Quiet = False,
    _explain: ExplainTraffic = False,
) -> None:
    """Map a recording or a live robot, and send places and keyscans to the cloud, through outages and restarts.

    With --localize, find a live robot in a finished map instead.
    """
    from fcslam.cli.live import map_live
    from fcslam.errors import InputError
    from fcslam.live.localized_robot import LocalizedRobot
    from fcslam.live.robot import Playback, Robot
    from fcslam.ros.addresses import is_address
    from fcslam.sources import BagOptions
    from fcslam.sources.faults import Fault
    from fcslam.storage.files import keep_private
    from fcslam.wire.keys import read_token

    keep_private()
    settings = mission_config(config, preset=preset)
    token = None if token_file is None else read_token(token_file)
    own = _own_certificate(certificate, key)
    if localize is None and initial_pose is not None:
        raise InputError("an initial pose is one in a finished map; give --localize, too")
    learning = RobotLearning(learn, learn_config, token_file, ca, own).checked(localize is not None)
    if is_address(source):
        start: Callable[..., Robot | LocalizedRobot] = partial(
            Robot, server=server, state=state, token=token, ca=ca, certificate=own, budget_kbps=budget_kbps,
            outbox_mb=outbox_mb, config=settings, floor=floor, keep_keyframes=learn,
        )  # fmt: skip
        if localize is not None:
            if state is not None:
                raise InputError("a robot that localises sends and keeps nothing; leave --state out")
            if server is not None:
                _fetch(localize, server, token, ca, own, notices(quiet))
            initial = None if initial_pose is None else pose("--initial-pose", initial_pose)
            start = partial(LocalizedRobot, map=localize, initial_pose=initial, config=settings, floor=floor)
        options = (
            bag_options(scan_topic, odom_topic, camera_topic, laser_pose, odom_frame, base_frame, cloud_band)
            or BagOptions()
        )
        parameters = node_parameters(ros_parameters, use_sim_time)
        plan = learning.plan(settings.robot, server, state)
        map_live(source, name, start, options, domain, parameters, output, notices(quiet), plan)
        return
    if localize is not None:
        raise InputError("--localize is for a live robot; `fcslam localize RECORDING --map MAP` localises a recording")
    server, state = _required(server, state)
    pace = _speed(speed)
    argument = source if name is None else f"{name}={source}"
    recording = open_recording(
        argument, bag_options(scan_topic, odom_topic, camera_topic, laser_pose, odom_frame, base_frame, cloud_band)
    )
    _check_name(recording.name)
    survey = recording.survey()
    console = notices(quiet)
    print_notes(console, survey.notes)
    plan = learning.plan(settings.robot, server, state)
    fingerprint = _fingerprint(recording.name, survey, settings.robot, budget_kbps, floor)
    live = Robot(
        recording.name, server=server, state=state, token=token, ca=ca, certificate=own, budget_kbps=budget_kbps,
        outbox_mb=outbox_mb, config=settings, own_map=False, floor=floor, keep_keyframes=learn,
        playback=Playback(fingerprint, resume),
    )  # fmt: skip
    with closing(live):
        _play(live, recording, survey.scan_count, pace, plan, state, console)
        print_faults(console, {recording.name: recording.faults.plus(Fault.ODOMETRY_JUMP, live.odometry_jumps)})
        _report(live, state, server)


def _play(
    live: "Robot", recording: "Source", scans: int, speed: float | None, plan: "RobotLearningPlan | None", state: Path,
    console: "Console",
) -> None:  # fmt: skip
    """Play a recording of ``scans`` scans to its robot, which learns afterwards if there is a plan for it."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.live.playback import PlaybackPace, play

    pace = PlaybackPace(speed, time.monotonic, time.sleep)
    try:
        with compiled(console), _interruptible(), ProgressDisplay(console) as display:
            watch = _watch(display, console, scans)
            stay = None if plan is None else partial(_learn, plan, console, display, watch)
            play(live, recording.records(), pace, watch, stay)
    except KeyboardInterrupt:
        left = live.status().waiting
        print_line(
            console, f"{left.packets} packets ({left.bytes / 1e3:.0f} kB) wait in {state}; to continue, give --resume"
        )
        raise


def _fetch(
    folder: Path, server: str, token: str | None, ca: Path | None, own: tuple[Path, Path] | None, console: "Console"
) -> None:
    """Copy the maps of the cloud to ``folder``, or say why the robot uses an earlier copy."""
    from fcslam.live.served_map import fetch_maps

    trouble = fetch_maps(folder, server, token, ca, own)
    copied = f"copied the maps of {server} to {folder}"
    print_line(console, f"{trouble}; the robot uses the earlier copy in {folder}" if trouble else copied)


def _learn(
    plan: "RobotLearningPlan", console: "Console", display: "ProgressDisplay",
    watch: "Callable[[RobotStatus], None]", robot: "Robot",
) -> None:  # fmt: skip
    """Stay after the drive and learn with the fleet, until the budget is spent or Ctrl-C ends it."""
    from fcslam.learning.federated.learning_beside import LearningBeside

    def tell(line: str) -> None:
        print_line(console, line)

    tell("the drive is over; the robot learns with its fleet until Ctrl-C")
    learning = LearningBeside(plan, robot.name, tell)
    began_s = time.monotonic()
    try:
        learning.set_idle(robot.first_epoch)
        while (passed_s := time.monotonic() - began_s) < plan.settings.time_s and not learning.has_ended:
            robot.stand_still()
            watch(robot.status())
            display.show("learning", round(passed_s), round(plan.settings.time_s))
            time.sleep(0.5)
    except KeyboardInterrupt:
        tell("learning ends; the robot sends what is left")
    finally:
        learning.close()


def _required(server: str | None, state: Path | None) -> tuple[str, Path]:
    """The options that the robot of a recording needs."""
    from fcslam.errors import InputError

    if server is None or state is None:
        raise InputError(
            "a recording needs --server and --state; `fcslam map` maps it without, and ros2:/NAMESPACE is a live robot"
        )
    return server, state


def _speed(text: str) -> float | None:
    """Playback speed as a multiple of real time; None: as fast as possible."""
    from fcslam.errors import InputError

    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed < float("inf"):
        raise InputError(f"--speed {text!r} is not a speed; give a factor above 0, or max")
    return speed


def _check_name(name: str) -> None:
    from fcslam.errors import PacketError, SourceError
    from fcslam.wire.checks import check_name

    try:
        check_name(name, "robot")
    except PacketError as error:
        raise SourceError(f"{error}; give another --name") from error
    stem, plus, number = name.rpartition("+")
    if plus and number.isdigit():
        raise SourceError(f"robot: {name!r} is how a later start of {stem!r} is called; give another --name")


def _own_certificate(certificate: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    from fcslam.errors import InputError

    if (certificate is None) != (key is None):
        raise InputError("--certificate and --key belong together; give both or neither")
    return None if certificate is None or key is None else (certificate, key)


def _fingerprint(name: str, survey: "Survey", settings: "RobotConfig", budget_kbps: float | None, floor: str) -> str:
    """A digest of the inputs that determine the packets; digests of the packets themselves reveal other changes."""
    import hashlib

    import fcslam
    from fcslam.config import dump

    length = survey.scan_count, survey.duration_s, survey.path_length_m
    inputs = (fcslam.__version__, name, *length, survey.lasers, budget_kbps, floor)
    return hashlib.sha256(f"{inputs} {dump(settings)}".encode()).hexdigest()


@contextmanager
def _interruptible() -> Iterator[None]:
    """Treat SIGTERM, which service managers send, like Ctrl-C."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _watch(display: "ProgressDisplay", console: "Console", total: int) -> "Callable[[RobotStatus], None]":
    """Show the progress of ``total`` scans, and print each change of the connection and of the robot's localisation."""
    trouble: str | None = "connecting"
    notices_before: tuple[str, ...] = ()
    localization, times_lost = "mapping", 0
    waits = sends = False

    def watch(now: "RobotStatus") -> None:
        nonlocal trouble, notices_before, localization, times_lost, waits, sends
        lines = [now.trouble or "connected"] * (now.trouble != trouble)
        if (now.localization, now.times_lost) != (localization, times_lost):
            lines.append(_localisation(now, times_lost))
        localization, times_lost = now.localization, now.times_lost
        for line in [*lines, *(notice for notice in now.notices if notice not in notices_before)]:
            print_line(console, line)
        is_complete = now.scans == total
        if is_complete and now.trouble and not waits:
            waits = True
            print_line(
                console,
                f"all scans are mapped; {now.waiting.packets} packets wait for the server. Ctrl-C ends the wait: they "
                "stay on disk, and --resume sends them",
            )
        trouble, notices_before = now.trouble, now.notices
        details = _details(now, is_complete)
        display.show("mapping", now.scans, total, details)
        sends = sends or (is_complete and now.waiting.packets > 0)
        if sends:
            display.show("sending", now.confirmed, now.confirmed + now.waiting.packets, details)

    return watch


def _localisation(now: "RobotStatus", times_lost_before: int) -> str:
    """Return a line on the place of a robot that was lost; ``times_lost_before``: its count at the last such line."""
    if now.quality > 0.0:
        return f"relocalised in map {now.map_index}, quality {now.quality:.2f}"
    if now.times_lost > times_lost_before:
        return "lost: the scans contradict the map; a new session begins here"
    return "not relocalised: no other closure supports the estimated place"


def _details(now: "RobotStatus", is_complete: bool) -> str:
    """The state of robot, connection, packets and map, the most important first: a narrow terminal cuts the end."""
    stage = "catching up" if now.catching_up else "sending" if is_complete else str(now.localization)
    details = [stage, "offline" if now.trouble else "online", f"{now.waiting.packets} waiting"]
    details += [f"{now.refused} refused"] if now.refused else []
    if now.map_index is None:
        details.append("in no map")
    else:
        age_s = now.correction_age_s or 0.0
        details.append(f"map {now.map_index}, quality {now.quality:.2f}, corrected {age_s:.0f} s ago")
    details += [f"{now.confirmed} packets confirmed", f"{now.sent_bytes / 1e3:.0f} kB sent"]
    details += [f"{now.left_out} places left out"] if now.left_out else []
    return ", ".join([*details, f"{now.keyscans} keyscans"])


def _report(robot: "Robot", state: Path, server: str) -> None:
    from fcslam.runs import write_tum

    now = robot.status()
    console = answers()
    print_line(
        console,
        f"{now.scans} scans, {now.keyscans} keyscans; {server} has confirmed all packets "
        f"({now.sent_bytes / 1e3:.0f} kB sent)",
    )
    if now.left_out:
        print_line(console, f"{now.left_out} places were left out: the outbox was full or the budget was spent")
    if now.refused:
        print_line(console, f"{now.refused} packets were refused: {state / 'refused'}")
    if now.times_lost:
        lost = f"lost {now.times_lost} times" if now.times_lost > 1 else "lost once"
        print_line(console, f"{lost}; {_localisation(now, now.times_lost)}")
    if now.map_index is not None:
        trajectory = robot.trajectory()
        write_tum(state / "trajectory.tum", trajectory.stamps, trajectory.T_map_base)
        print_line(console, f"trajectory in map {now.map_index}: {state / 'trajectory.tum'}")
