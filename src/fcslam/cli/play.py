"""`fcslam play`: a recording played to a cloud service, as if its robot drove now."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.inputs import open_recording, print_faults, print_notes
from fcslam.cli.options import (
    STATE,
    Budget,
    ConfigFiles,
    Credentials,
    Floor,
    Quiet,
    Sensors,
    ServerUrl,
    Space,
    access,
    mission_config,
)
from fcslam.cli.output import notices, once_printer, print_line
from fcslam.cli.training_options import Learn, learning_plan
from fcslam.cli.warm_up import compiled, copied_process
from fcslam.errors import InputError, PacketError, writing

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.federated.learning_process import RobotLearningPlan
    from fcslam.live.records import RobotStatus
    from fcslam.live.robot import Robot
    from fcslam.records import SensorRecord
    from fcslam.robot.frontend import RobotConfig
    from fcslam.sources import Survey


def play(
    recording: Annotated[
        str,
        typer.Argument(
            metavar="LOG", help="The robot's recording, which names the robot; NAME=LOG gives another name."
        ),
    ],
    *,
    server: ServerUrl = None,
    credentials: Credentials = None,
    budget_kBps: Budget = None,
    state: Annotated[Path, STATE],
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted recording instead of starting it again.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(min=0.01, help="Playback speed as a multiple of real time.", show_default="as fast as possible"),
    ] = None,
    floor: Floor = "",
    config: ConfigFiles = None,
    in_space: Space = False,
    sensors: Sensors = None,
    learn: Learn = False,
    quiet: Quiet = False,
) -> None:
    """Map a recording, and send its places and keyscans to the cloud, through outages and restarts."""
    from fcslam.api import notes_in_space
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.cloud.sessions import check_robot
    from fcslam.live.records import Wiring
    from fcslam.live.robot import Robot
    from fcslam.records import CloudScan
    from fcslam.sources.faults import Fault
    from fcslam.storage.files import keep_private

    keep_private()
    settings, cloud = mission_config(config, in_space=in_space), access(server, credentials, budget_kBps)
    if cloud is None:
        raise InputError("a recording is played to a service; give --server, or map it here with `fcslam map`")
    pace = PlaybackPace(speed, time.monotonic, time.sleep)
    console = notices(quiet)
    in_3d = settings.fleet.dimensions == 3
    opened, survey = open_recording(recording, sensors, console, in_3d, settings.robot.lidar)
    print_notes(console, notes_in_space([opened], settings))
    try:
        check_robot(opened.name)
    except PacketError as error:
        raise InputError(f"{error}; give another one: NAME=LOG") from error
    plan = learning_plan(settings.robot, cloud, credentials, state) if learn else None
    fingerprint = _fingerprint(opened.name, survey, settings.robot, cloud.budget_kBps, floor)
    records = opened.records()
    first = list(islice(records, 1))
    lidar_3d = any(isinstance(record, CloudScan) for record in first)
    with copied_process(None if lidar_3d else settings.robot) as worker:
        wiring = Wiring(worker, recording=fingerprint, resumes=resume, keeps_keyframes=learn)
        robot = Robot(
            opened.name,
            server=cloud,
            state=state,
            config=settings,
            own_map=False,
            floor=floor,
            lidar_3d=lidar_3d,
            wiring=wiring,
        )
        with closing(robot):
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # service managers send it
            try:
                with compiled(console, lidar_3d), ProgressDisplay(console) as display:
                    watch = robot_watch(display, console, survey.scan_count)
                    stay = None if plan is None else partial(_learn, plan, console, display, watch)
                    play_records(robot, chain(first, records), pace, watch, stay)
            except KeyboardInterrupt:
                left = robot.status().waiting
                print_line(
                    console,
                    f"{left.packets} packets ({left.bytes / 1e3:.0f} kB) wait in {state}; to continue, give --resume",
                )
                raise
            print_faults(console, {opened.name: opened.faults.plus(Fault.ODOMETRY_JUMP, robot.odometry_jumps)})
            _report(robot, state, cloud.url)


def _learn(
    plan: "RobotLearningPlan",
    console: "Console",
    display: "ProgressDisplay",
    watch: "Callable[[RobotStatus], None]",
    robot: "Robot",
) -> None:
    from fcslam.learning.federated.learning_process import LearningProcess

    notify = partial(print_line, console)
    notify("the drive is over; the robot learns with its fleet until Ctrl-C")
    with closing(LearningProcess(plan, robot.name, notify)) as learning:
        began_s = time.monotonic()
        try:
            learning.set_idle(True)
            while (passed_s := time.monotonic() - began_s) < plan.settings.time_s and not learning.has_ended:
                robot.idle()
                watch(robot.status())
                display.show("learning", round(passed_s), round(plan.settings.time_s))
                time.sleep(0.5)
        except KeyboardInterrupt:
            notify("learning ends; the robot sends what is left")


def _fingerprint(name: str, survey: "Survey", settings: "RobotConfig", budget_kBps: float | None, floor: str) -> str:
    """A digest of the inputs that determine the packets; digests of the packets themselves reveal other changes."""
    import hashlib

    import fcslam
    from fcslam.config import dump

    length = survey.scan_count, survey.duration_s, survey.path_length_m
    inputs = (fcslam.__version__, name, *length, survey.lasers, budget_kBps, floor)
    return hashlib.sha256(f"{inputs} {dump(settings)}".encode()).hexdigest()


def robot_watch(display: "ProgressDisplay", console: "Console", total: int) -> "Callable[[RobotStatus], None]":
    """Show the progress of ``total`` scans, and print each change of the connection and of the robot's localization."""
    before: RobotStatus | None = None
    sends, print_once = False, once_printer(console)

    def watch(now: "RobotStatus") -> None:
        nonlocal before, sends
        for line in _news(now, before):
            print_line(console, line)
        before, is_complete = now, now.scans == total
        if is_complete and now.trouble:
            print_once(
                "all scans are mapped, and packets wait for the server. Ctrl-C ends the wait: --resume sends them"
            )
        details = _details(now, is_complete)
        display.show("mapping", now.scans, total, details)
        sends = sends or (is_complete and now.waiting.packets > 0)
        if sends:
            display.show("sending", now.confirmed, now.confirmed + now.waiting.packets, details)

    return watch


def _news(now: "RobotStatus", before: "RobotStatus | None") -> Iterator[str]:
    if now.trouble != ("connecting" if before is None else before.trouble):
        yield now.trouble or "connected"
    was, times_lost = ("mapping", 0) if before is None else (before.localization, before.times_lost)
    if (now.localization, now.times_lost) != (was, times_lost):
        yield _localization(now, times_lost)
    yield from (notice for notice in now.notices if before is None or notice not in before.notices)


def _localization(now: "RobotStatus", times_lost_before: int) -> str:
    """Return a line on the place of a robot that was lost; ``times_lost_before``: its count at the last such line."""
    if now.quality > 0.0:
        return f"relocalized in map {now.map_index}, quality {now.quality:.2f}"
    if now.times_lost > times_lost_before:
        return "lost: the scans contradict the map; a new session begins here"
    return "not relocalized: no other closure supports the estimated place"


def _details(now: "RobotStatus", is_complete: bool) -> str:
    """The state of robot, connection, packets and map, the most important first: a narrow terminal cuts the end."""
    stage = "catching up" if now.is_catching_up else "sending" if is_complete else str(now.localization)
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
    typer.echo(
        f"{now.scans} scans, {now.keyscans} keyscans; {server} has confirmed all packets "
        f"({now.sent_bytes / 1e3:.0f} kB sent)",
    )
    if now.left_out:
        typer.echo(f"{now.left_out} places were left out: the outbox was full or the budget was spent")
    if now.refused:
        typer.echo(f"{now.refused} packets were refused: {state / 'refused'}")
    if now.times_lost:
        lost = f"lost {now.times_lost} times" if now.times_lost > 1 else "lost once"
        typer.echo(f"{lost}; {_localization(now, now.times_lost)}")
    if now.map_index is not None:
        trajectory = robot.trajectory()
        with writing(state / "trajectory.tum"):
            write_tum(state / "trajectory.tum", trajectory.stamps, trajectory.poses)
        typer.echo(f"trajectory in map {now.map_index}: {state / 'trajectory.tum'}")
    else:
        typer.echo("no correction came before the end, so there is no trajectory.tum; the result of the service has it")


class PlaybackPace:
    """Paces a recording by its own clock."""

    def __init__(self, speed: float | None, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """``speed``: factor of the recorded speed; None: as fast as the robot can map."""
        self._speed = speed
        self._clock = clock
        self._sleep = sleep
        self._origin: tuple[float, float] | None = None
        """The first stamp, and the time of the clock at which it was due."""

    def wait(self, stamp: float) -> None:
        """Sleep until ``stamp`` is due; the first stamp is due at once."""
        if self._speed is None:
            return
        if self._origin is None:
            self._origin = stamp, self._clock()
        due = self._origin[1] + (stamp - self._origin[0]) / self._speed
        self._sleep(max(0.0, due - self._clock()))


def play_records(
    robot: "Robot",
    records: "Iterable[SensorRecord]",
    pace: PlaybackPace,
    watch: "Callable[[RobotStatus], None]",
    stay: "Callable[[Robot], None] | None" = None,
) -> None:
    """Map a whole recording and send all packets; what a resumed robot did before is not paced.

    ``stay`` is called after the last record, before the recording ends.
    """
    from fcslam.records import CloudScan, LaserScan

    for record in records:
        if isinstance(record, LaserScan | CloudScan) and not robot.status().is_catching_up:
            pace.wait(record.stamp)
        robot.add(record)
        robot.wait_for_room(watch)
        watch(robot.status())
    if stay is not None:
        stay(robot)
    robot.finish(watch=watch)
