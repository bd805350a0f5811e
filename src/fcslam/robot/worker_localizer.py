"""Localization in a finished map beside the tracker of a live robot: no pose of a scan waits for a search of the map.

The tracker gives the pose in ``odom`` at once. Where ``odom`` lies in the map is known at the newest keyscan that
the worker has handled; the robot's own motion carries it on until the next one.
"""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass

from fcslam.errors import FcslamError
from fcslam.lidar.frozen_map import frozen_map
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import FloatArray
from fcslam.robot.backend import BackendInput, NewKeyscan, SessionEnd
from fcslam.robot.map_localizer import MapEstimate, MapLocalizer
from fcslam.wire.messages import Body


@dataclass(frozen=True, slots=True, eq=False)
class MapState:
    """State of a localizer after an input."""

    session: int
    """Number of the session, from 0; ``odom`` is another frame in each."""
    estimate: MapEstimate | None
    """None: the robot was not localized."""
    fixes: int
    losses: int


class WorkerLocalizer:
    """Runs a ``MapLocalizer`` in the only worker of an executor; a ``BackendRunner`` for ``RobotFrontend``."""

    def __init__(self, robot: str, occupancy: OccupancyMap, initial: FloatArray | None, executor: Executor) -> None:
        """Load the map into the worker; arguments as for ``MapLocalizer``."""
        self._robot, self._executor = robot, executor
        self.state = MapState(0, None, 0, 0)
        """After the newest input that the worker has handled."""
        self.keyscans = 0
        """Number of keyscans so far."""
        executor.submit(_begin, robot, occupancy, initial).result()

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Queue the next input."""
        self.keyscans += isinstance(input, NewKeyscan)
        return self._queue(_process, input)

    def suggest(self, T_map_odom: FloatArray) -> None:
        """As ``MapLocalizer.suggest``, after the inputs so far."""
        self._queue(_suggest, T_map_odom)

    def _queue(self, function: "Callable[..., MapState]", argument: object) -> "Future[list[Body]]":
        handled: Future[list[Body]] = Future()

        def take(done: "Future[MapState]") -> None:
            error = FcslamError("the robot was closed") if done.cancelled() else done.exception()
            if error is None:
                self.state = done.result()
                handled.set_result([])
            else:  # nobody follows the robot any more
                self.state = MapState(self.state.session, None, self.state.fixes, self.state.losses)
                handled.set_exception(error)

        try:
            asked = self._executor.submit(function, self._robot, argument)
        except RuntimeError as error:  # the worker has ended, or the executor was shut down
            asked = Future()
            asked.set_exception(error)
        asked.add_done_callback(take)
        return handled


@dataclass(slots=True)
class _Localization:
    """One robot in this worker."""

    localizer: MapLocalizer
    session: int = 0

    @property
    def state(self) -> MapState:
        return MapState(self.session, self.localizer.estimate, self.localizer.fixes, self.localizer.losses)


_localizations: dict[str, _Localization] = {}
"""By robot."""


def _begin(robot: str, occupancy: OccupancyMap, initial: FloatArray | None) -> None:
    _localizations[robot] = _Localization(MapLocalizer(frozen_map(occupancy, "the map"), initial))


def _process(robot: str, input: BackendInput) -> MapState:
    here = _localizations[robot]
    here.localizer.submit(input)
    here.session += isinstance(input, SessionEnd)
    return here.state


def _suggest(robot: str, T_map_odom: FloatArray) -> MapState:
    _localizations[robot].localizer.suggest(T_map_odom)
    return _localizations[robot].state
