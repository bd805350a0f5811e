"""A back end that runs beside the tracker: the same packets, only later, and no scan waits for it."""

import os
import signal
from concurrent.futures import BrokenExecutor, Future

import pytest

from fcslam.records import Channel, Constraint, ConstraintKind, Keyscan, Place
from fcslam.robot.backend_runner import copied_worker, in_worker
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.wire.packets import encode
from tests import small_fleet
from tests.live.same_thread import SameThread
from tests.robot.kidnapping import kidnapping

pytestmark = pytest.mark.slow

CONFIG = RobotConfig(channels=(Channel.LIDAR,))


@pytest.fixture(scope="module")
def scans():
    return list(small_fleet.draw(1, path_length_m=12.0).robots[0].scans())


class Held(SameThread):
    """Works on request, and breaks after so many tasks."""

    def __init__(self, breaks_after=10**9):
        super().__init__()
        self._left = breaks_after

    def submit(self, function, /, *arguments):
        return super().submit(self._done, function, *arguments)

    def _done(self, function, *arguments):
        self._left -= 1
        if self._left < 0:
            raise BrokenExecutor("it was killed")
        return function(*arguments)


def driven(scans, backend=None):
    return small_fleet.driven(scans, CONFIG, backend=backend)


def contents(packets):
    return [encode(packet) for packet in packets]


def test_poses_are_known_while_the_back_end_is_busy(scans):
    inline, expected = driven(scans)
    executor = Held()
    robot = RobotFrontend("r", CONFIG, in_worker("r", CONFIG, executor))
    executor.holds = True
    for number, scan in enumerate(scans, start=1):
        assert robot.process(scan) == []
        assert len(robot.scan_poses) == number
    assert robot.scan_poses.T_odom_base().tobytes() == inline.scan_poses.T_odom_base().tobytes()
    assert robot.packets.backlog == sum(isinstance(packet.body, Keyscan) for packet in expected)
    executor.work()
    executor.holds = False
    assert contents([*robot.ready(), *robot.finish()]) == contents(expected)
    assert robot.packets.backlog == 0


def test_sessions_of_a_lost_robot_come_in_order_when_the_back_end_is_late():
    scans, _ = kidnapping()
    executor = Held()
    backend = in_worker("r", CONFIG, executor)
    robot, packets = RobotFrontend("r", CONFIG, backend), []
    for number, scan in enumerate(scans):
        executor.holds = number % 40 != 0
        packets += robot.process(scan)
    executor.holds = False
    executor.work()
    assert contents(packets + robot.finish()) == contents(driven(scans)[1])


def test_a_back_end_that_breaks_costs_closures_and_places_but_no_keyscan(scans):
    expected = driven(scans)[1]
    robot, packets = driven(scans, in_worker("r", CONFIG, Held(breaks_after=10)))
    assert robot.packets.failure == "BrokenExecutor: it was killed"
    assert contents(packets[:10]) == contents(expected[:10])
    kept = [p.body for p in expected if not isinstance(p.body, Place) and not is_closure(p.body)]
    assert contents_of([packet.body for packet in packets]) == contents_of(kept)
    assert [packet.sequence for packet in packets] == list(range(len(packets)))


def test_an_input_that_a_breaking_executor_loses_is_not_waited_for(scans):
    class Losing(Held):
        def submit(self, function, /, *arguments):
            if self._left > 0:
                return super().submit(function, *arguments)
            self._left -= 1
            if self._left == -1:
                return Future()
            raise BrokenExecutor("it was killed")

    expected = driven(scans)[1]
    _, packets = driven(scans, in_worker("r", CONFIG, Losing(breaks_after=3)))
    assert keyscans(packets) == keyscans(expected)


def keyscans(packets):
    return sum(isinstance(packet.body, Keyscan) for packet in packets)


def is_closure(body):
    return isinstance(body, Constraint) and body.kind is ConstraintKind.CLOSURE


def contents_of(bodies):
    """Which records, without their numbers."""
    return [(type(body), getattr(body, "id", None), getattr(body, "j", None)) for body in bodies]


def test_a_process_beside_the_robot_gives_the_same_bytes_and_its_end_stops_nothing(scans):
    expected = driven(scans)[1]
    with copied_worker() as executor:
        backend = in_worker("r", CONFIG, executor)
        assert contents(driven(scans, backend)[1]) == contents(expected)
        worker = executor.submit(os.getpid).result()
        for stop in (signal.SIGINT, signal.SIGTERM):  # meant for the robot, which ends the worker itself
            os.kill(worker, stop)
        assert executor.submit(os.getpid).result() == worker
        os.kill(worker, signal.SIGKILL)
        robot, packets = driven(scans, backend)
        assert "BrokenProcessPool" in robot.packets.failure
        assert keyscans(packets) == keyscans(expected)
