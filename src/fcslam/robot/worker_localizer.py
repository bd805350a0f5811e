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
from fcslam.robot.worker_object import WorkerObject
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
        self.state = MapState(0, None, 0, 0)
        """After the newest input that the worker has handled."""
        self.keyscans = self._sessions = 0
        """Number of keyscans so far."""
        self._localizer = WorkerObject(executor, f"localizer of {robot}", _localizer, occupancy, initial)

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Queue the next input."""
        self.keyscans += isinstance(input, NewKeyscan)
        self._sessions += isinstance(input, SessionEnd)
        return self._queue(MapLocalizer.submit, input)

    def suggest(self, T_map_odom: FloatArray) -> None:
        """As ``MapLocalizer.suggest``, after the inputs so far."""
        self._queue(MapLocalizer.suggest, T_map_odom)

    def _queue(self, method: Callable[..., object], argument: object) -> "Future[list[Body]]":
        handled: Future[list[Body]] = Future()
        session = self._sessions

        def take(done: "Future[Found]") -> None:
            error = FcslamError("the robot was closed") if done.cancelled() else done.exception()
            if error is None:
                self.state = MapState(session, *done.result())
                handled.set_result([])
            else:  # nobody follows the robot any more
                self.state = MapState(self.state.session, None, self.state.fixes, self.state.losses)
                handled.set_exception(error)

        self._localizer.call(_after, method, argument).add_done_callback(take)
        return handled


Found = tuple[MapEstimate | None, int, int]
"""Estimate, fixes and losses."""


def _localizer(occupancy: OccupancyMap, initial: FloatArray | None) -> MapLocalizer:
    return MapLocalizer(frozen_map(occupancy, "the map"), initial)


def _after(localizer: MapLocalizer, method: Callable[..., object], argument: object) -> Found:
    """What is known once a method has been called."""
    method(localizer, argument)
    return localizer.estimate, localizer.fixes, localizer.losses
