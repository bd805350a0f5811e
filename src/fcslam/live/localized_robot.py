"""A robot that finds its pose in a finished map live: scans in, its pose in the map out. The map does not change.

The tracker runs in the thread that adds a scan. The search of the map and the match with it run in a worker beside it,
which is another process, so no pose waits for them.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fcslam.api import settings_of
from fcslam.errors import FcslamError, InputError
from fcslam.geometry import se2
from fcslam.lidar.frozen_map import frozen_map
from fcslam.live.inputs import Lasers
from fcslam.live.records import WIRED, EventKind, RobotEvent, RobotPose, RobotStatus, Wiring
from fcslam.live.tracker import LiveTracker
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.mission.localization import FinishedMap, LocalizedDrive, pose_in_map, read_map
from fcslam.mission.mission import MissionConfig
from fcslam.records import FloatArray, StrPath, frozen
from fcslam.robot.backend import BackendInput, NewKeyscan, Task
from fcslam.robot.backend_runner import WorkerObject
from fcslam.robot.frontend import NewestScan, RobotFrontend
from fcslam.robot.map_localizer import MapEstimate, MapLocalizer
from fcslam.runs import RobotTrajectory, Run, prepare_output
from fcslam.warmup import warm_up_tracking
from fcslam.wire.messages import Body, Packet

if TYPE_CHECKING:
    from fcslam.robot.frontend3d import NewestTurn

_NOWHERE = MapEstimate(frozen(np.full(3, np.nan)), frozen(np.full((3, 3), np.nan)), 0.0)
"""The estimate of a robot that is not localized."""


class LocalizedRobot(LiveTracker):
    """One robot in a finished map.

        with fcslam.LocalizedRobot("anna", "runs/building", laser) as robot:
            for ranges_m, stamp, odometry in my_driver():
                pose = robot.add_scan(ranges_m, stamp, odometry)
                if pose.is_localized:
                    print(pose.x, pose.y, pose.theta)

    Its starting pose need not be known. While the robot does not know where it is, its poses are NaN, never a guess.
    Threads and processes are as for ``fcslam.Robot``. It needs no network, and it sends and keeps nothing.
    """

    fleet = None
    """The robot follows no fleet."""
    _frontend: RobotFrontend

    def __init__(
        self,
        name: str,
        map: StrPath | OccupancyMap,  # the word that users expect
        laser: Lasers | None = None,
        *,
        initial_pose: ArrayLike | None = None,
        floor: str = "",
        config: MissionConfig | Mapping[str, Any] | StrPath | None = None,
        on_event: Callable[[RobotEvent], None] | None = None,
        wiring: Wiring = WIRED,
    ) -> None:
        """Start the robot; takes some seconds, after which the first scan is as quick as every other.

        Args:
            name: of the robot; letters, digits and ``. _ -``.
            map: a run folder; a mission file, which is mapped first; the YAML file of a ROS map with the PGM file
                beside it; or a map.
            laser: its LiDAR, or several by name. None: only ``add`` is used.
            initial_pose: about where it starts in the map, (x, y, theta), metres and radians. None: anywhere.
            floor: floor that the robot is on, whose first map is used; it must be named if the run has maps of several
                floors.
            config: as in ``map_recordings``; ``robot`` counts.
            on_event: called by ``add_scan`` and ``add``, in their thread, before they return.
            wiring: for fcslam's own commands and tests.

        Raises:
            InputError: the name, a laser, the configuration, map or pose cannot be used, or the worker does not start.
        """
        super().__init__(name, laser, settings_of(config), on_event)
        self._map = map if isinstance(map, OccupancyMap) else read_map(Path(map), floor)
        initial = None if initial_pose is None else pose_in_map("initial_pose", initial_pose, self._map)
        self._drive = LocalizedDrive()
        self._was_localized = False
        self._found: MapEstimate | None = None
        """The newest result of the worker; None: the robot was not localized."""
        self._found_session = 0
        """Its session: ``odom`` is another frame in each."""
        self._fixes = self._losses = 0
        self._keyscans = self._submitted_sessions = 0
        robot = self._config.robot
        with ExitStack() as stack:
            executor = self._executor = wiring.started(stack)
            try:
                self._localizer = WorkerObject(executor, f"localizer of {name}", _localizer, self._map, initial)
            except BrokenExecutor as error:
                raise InputError(
                    f"{self.name}: the process that searches the map does not start; a script that makes a "
                    'LocalizedRobot needs `if __name__ == "__main__":` around its own code'
                ) from error
            self._frontend = RobotFrontend(self.name, robot, self._submit)
            warm_up_tracking(robot)
            self._stack = stack.pop_all()

    def suggest_pose(self, pose: ArrayLike) -> None:
        """Suggest an approximate pose of the robot now. Any thread may call this.

        The robot uses the pose once the walls around it confirm it, and drops it after 15 m of travel without that.

        Args:
            pose: (x, y, theta) of ``base`` in the map, metres and radians.
        """
        T_map_base = pose_in_map("pose", pose, self._map)
        with self._lock:
            newest = self._frontend.newest
            here = np.zeros(3) if newest is None else self._frontend.scan_poses.in_odom(newest.pose)
            self._queue(MapLocalizer.suggest, se2.compose(T_map_base, se2.inverse(here)))

    def status(self) -> RobotStatus:
        """Return the state of the robot: whether it knows its pose, and counts since its start."""
        estimate, failure = self._estimate(), self._frontend.packets.failure
        broken = f"not localized any more, as the search failed: {failure}" if failure else None
        jumps = "the odometry jumps; scan matching bridges it" if self.odometry_jumps else None
        return RobotStatus(
            scans=self._scans,
            keyscans=self._keyscans,
            map_index=0,
            times_lost=self._losses,
            quality=0.0 if estimate is None else estimate.quality,
            notices=tuple(filter(None, (broken, jumps))),
            is_localized=estimate is not None,
        )

    def map(self) -> OccupancyMap:
        """The map, which never changes."""
        return self._map

    def joint_map(self) -> None:
        """None: the robot makes no map with others."""

    def own_map(self) -> OccupancyMap:
        """As ``map``."""
        return self._map

    def points(self) -> None:
        """None: the robot makes no map in space."""

    def closures(self) -> FloatArray:
        """Both ends of each loop closure, shape (0, 2, 2): the robot makes no map."""
        return np.empty((0, 2, 2))

    def trajectory(self) -> RobotTrajectory:
        """The poses of the scans at which the robot was localized, as ``add_scan`` returned them."""
        with self._lock:
            return self._drive.poses(self.name).believed()

    def finish(self) -> None:
        """End the drive. Nothing can be added after it."""
        self._is_finished = True

    def save(self, folder: StrPath, force: bool = False) -> Run:
        """Write a run folder of the poses that ``add_scan`` returned, as ``fcslam localize`` does, and return the run.

        Args:
            folder: the folder to make.
            force: replace a run that is there.
        """
        prepare_output(Path(folder), force)
        with self._lock:
            run = self._drive.run(self.name, FinishedMap(self._map), self._config, self._fixes, self._losses)
        run.save(folder, force)
        return run

    def _estimate(self) -> MapEstimate | None:
        return self._found if self._found_session == self._session else None

    def _submit(self, input: BackendInput) -> "Future[list[Body]]":
        self._keyscans += isinstance(input, NewKeyscan)
        self._submitted_sessions += input is Task.END_SESSION
        return self._queue(MapLocalizer.submit, input)

    def _queue(self, method: Callable[..., object], argument: object) -> "Future[list[Body]]":
        handled: Future[list[Body]] = Future()
        session = self._submitted_sessions

        def take(done: "Future[tuple[MapEstimate | None, int, int]]") -> None:
            error = FcslamError("the robot was closed") if done.cancelled() else done.exception()
            if error is None:
                self._found, self._fixes, self._losses = done.result()
                self._found_session = session
                handled.set_result([])
            else:  # nobody follows the robot any more
                self._found = None
                handled.set_exception(error)

        self._localizer.call(_after, method, argument).add_done_callback(take)
        return handled

    def _take(self, packets: list[Packet]) -> None:
        """Nothing leaves a robot that makes no map."""

    def _pose_of(
        self, newest: "NewestScan | NewestTurn", T_smooth_base: FloatArray, T_odom_base: FloatArray | None
    ) -> RobotPose:
        known = None if newest.is_deferred else self._estimate()
        self._drive.add(newest.pose.stamp, self._frontend.travel_m, T_smooth_base, known)
        estimate = known or _NOWHERE
        return RobotPose(
            newest.pose.stamp,
            frozen(se2.compose(estimate.T_map_odom, T_smooth_base)),
            T_odom_base,
            estimate.quality,
            known is not None,
            0,
            self._frontend.belief,
            estimate.covariance,
        )

    def _tell(self) -> None:
        estimate, was_localized = self._estimate(), self._was_localized
        self._was_localized = estimate is not None
        if estimate is not None and not was_localized:
            self._event(EventKind.LOCALIZED, f"localized, quality {estimate.quality:.2f}")
        elif estimate is None and was_localized:
            self._event(EventKind.LOST, "not localized any more: the walls are others than in the map")
        if self._frontend.packets.failure:
            self._tell_failure(f"not localized from now on, as the search failed: {self._frontend.packets.failure}")


def _localizer(occupancy: OccupancyMap, initial: FloatArray | None) -> MapLocalizer:
    return MapLocalizer(frozen_map(occupancy, "the map"), initial)


def _after(
    localizer: MapLocalizer, method: Callable[..., object], argument: object
) -> tuple[MapEstimate | None, int, int]:
    """Estimate, fixes and losses after a call."""
    method(localizer, argument)
    return localizer.estimate, localizer.fixes, localizer.losses
