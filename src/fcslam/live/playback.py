"""A recording played to a live robot, by its own clock or as fast as the robot can map."""

from collections.abc import Callable, Iterable

from fcslam.live.records import RobotStatus
from fcslam.live.robot import Robot
from fcslam.records import LaserScan, SensorRecord

Watch = Callable[[RobotStatus], None]


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


def play(
    robot: Robot,
    records: Iterable[SensorRecord],
    pace: PlaybackPace,
    watch: Watch,
    stay: Callable[[Robot], None] | None = None,
) -> None:
    """Map a whole recording and send all packets; what a resumed robot did before is not paced.

    ``stay`` is called after the last record, before the recording ends.
    """
    for record in records:
        if isinstance(record, LaserScan) and not robot.status().is_catching_up:
            pace.wait(record.stamp)
        robot.add(record)
        robot.wait_for_room(watch)
        watch(robot.status())
    if stay is not None:
        stay(robot)
    robot.finish(watch=watch)
