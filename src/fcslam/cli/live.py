"""A live robot on a ROS network, for `fcslam robot` and `fcslam localize`."""

import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fcslam.cli.inputs import LiveSource, print_faults
from fcslam.cli.output import RUNS, new_folder, print_line
from fcslam.cli.warm_up import compiled
from fcslam.errors import FcslamError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.learning.federated.learning_process import LearningProcess, RobotLearningPlan
    from fcslam.live.localized_robot import LocalizedRobot
    from fcslam.live.records import RobotEvent, RobotPose
    from fcslam.live.robot import Robot
    from fcslam.ros.node import RobotNode

SERVER_PATIENCE_S = 60.0
"""Longest wait for the server at the end of a drive."""


@contextmanager
def stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` at Ctrl-C and SIGTERM, so that what was mapped or recorded is kept; a second Ctrl-C interrupts."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    stopped = threading.Event()

    def end(*_: object) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt
        stopped.set()
        stop()

    for number in before:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def drive_live(
    live: LiveSource,
    start: "Callable[..., Robot | LocalizedRobot]",
    output: Path | None,
    console: "Console",
    learning: "RobotLearningPlan | None" = None,
) -> None:
    """Run a live robot until it is stopped, and write the run to ``output``; ``start`` makes the robot.
    With a plan for ``learning``, it learns while it stands still.
    """
    from fcslam.live.localized_robot import LocalizedRobot
    from fcslam.live.records import EventKind
    from fcslam.ros.node import RobotNode, await_sensors, open_network
    from fcslam.runs import prepare_output
    from fcslam.sources import IN_PLANE

    output = new_folder(RUNS) if output is None else output
    prepare_output(output, force=False)
    sys.setswitchinterval(0.001)  # a thread that publishes yields to the one that maps; Python's own is 5 ms
    logging.getLogger("fcslam.live").addHandler(logging.NullHandler())  # its events are printed below

    notify = partial(print_line, console)

    def print_event(event: "RobotEvent") -> None:
        if event.kind is not EventKind.CORRECTED:  # there are many
            notify(event.text)

    with closing(open_network(live.address.network)) as network, ExitStack() as stack:
        namespace = live.address.namespace
        topics = await_sensors(network, namespace, live.options, live.parameters.topic_timeout)
        for note in topics.notes:
            notify(note)
        if live.options.in_3d and not topics.in_space:
            notify(IN_PLANE.format(live.name))
        stack.enter_context(compiled(console, topics.in_space))
        of_lidar = {"lidar_3d": True} if topics.in_space else {}
        robot = start(live.name, on_event=print_event, **of_lidar)
        stack.enter_context(closing(robot))
        suggest_pose = robot.suggest_pose if isinstance(robot, LocalizedRobot) else None
        change_floor = None if isinstance(robot, LocalizedRobot) else robot.change_floor
        node = RobotNode(
            network, namespace, topics, live.options, robot, live.parameters, notify, suggest_pose, change_floor
        )
        heard = ", ".join((*topics.scans, topics.odometry or topics.transforms[0]))
        notify(f"{robot.name}: reads {heard}; Ctrl-C ends the drive and writes {output}")
        with stopping(node.stop):  # also while the run is written: a late SIGTERM must not lose it
            if learning is None or isinstance(robot, LocalizedRobot):
                failure = _drive(node, pose_watch(notify, lambda _: None))
            else:
                from fcslam.learning.federated.learning_process import LearningProcess

                with standstill_learning(LearningProcess(learning, robot.name, notify), robot) as follow:
                    failure = _drive(node, pose_watch(notify, follow))
            if not node.scans:
                notify("no scan was mapped; nothing is written")
                return
            failure = _finish(robot, notify) or failure
            node.publish_map()
            run = robot.save(output)
        print_faults(console, {robot.name: node.sensors.audit.faults()})
    typer.echo(f"{node.scans} scans, {len(run.trajectories)} sessions: {output}")
    if failure is not None:
        raise failure


def _drive(node: "RobotNode", watch: Callable[[int, "RobotPose | None"], None]) -> FcslamError | None:
    """Map until the node is stopped, or until an error, which it returns if there are scans to save."""
    try:
        node.run(watch)
    except FcslamError as error:
        if not node.scans:
            raise
        return error
    return None


def _finish(robot: "Robot | LocalizedRobot", notify: Callable[[str], None]) -> FcslamError | None:
    """End the drive; returns why the server or the state folder cannot be used. The run is written all the same."""
    from fcslam.live.localized_robot import LocalizedRobot

    try:
        if isinstance(robot, LocalizedRobot):
            robot.finish()
        elif not robot.finish(SERVER_PATIENCE_S):
            notify("the server does not have everything; the rest is sent at the next start with the same --state")
    except InputError as error:
        return error
    return None


@contextmanager
def standstill_learning(learning: "LearningProcess", robot: "Robot") -> "Iterator[Callable[[RobotPose], None]]":
    """Let a process learn while its robot stands still; gives what follows the robot's poses."""
    from fcslam.learning.federated.learning_process import Standstill

    with closing(learning):

        def stop() -> None:
            try:
                robot.idle()
            except InputError:  # an event named it; the robot maps on, but does not learn
                return
            learning.set_idle(True)

        yield Standstill(stop, lambda: learning.set_idle(False)).follow


def pose_watch(
    notify: Callable[[str], None], follow: "Callable[[RobotPose], None]"
) -> "Callable[[int, RobotPose | None], None]":
    """Follow the poses of the scans, and print a line of progress for many scans."""
    reported = 0

    def watch(scans: int, pose: "RobotPose | None") -> None:
        nonlocal reported
        if pose is None or scans == reported:
            return
        reported = scans
        follow(pose)
        if scans % 600 == 0:
            notify(f"{scans} scans")

    return watch
