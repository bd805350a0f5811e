"""A robot that maps live: scans in, its pose in the map out.

The tracker runs in the thread that adds a scan. All else, loop closing, the map and place recognition, runs in a worker
beside it, which is another process, so no pose waits for it.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Executor, wait
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from fcslam.api import StrPath, settings_of
from fcslam.cloud.sessions import session_name
from fcslam.driving import track_of
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.live.inputs import Lasers, checked_lasers, checked_robot, checked_scan
from fcslam.live.own_map import OwnMap
from fcslam.live.records import EventKind, RobotEvent, RobotPose
from fcslam.mission import MissionConfig
from fcslam.records import Correction, FloatArray, LaserScan, SensorRecord, frozen
from fcslam.robot.beside import Beside, worker_process
from fcslam.robot.frontend import NewestScan, RobotFrontend
from fcslam.robot.localization import Localizer
from fcslam.robot.warmup import warm_up_tracking
from fcslam.runs import RobotTrajectory, Run, prepare_output
from fcslam.runs.map_files import OccupancyMap
from fcslam.wire.messages import Packet

JUMP_M, JUMP_RAD = 0.01, 0.005
"""Corrections that move the robot by less are no event."""

_log = logging.getLogger(__name__)


class Robot:
    """One robot that maps while it drives.

        laser = fcslam.LaserModel(beam_count=360, angle_min_rad=-math.pi, angle_increment_rad=math.radians(1.0),
                                  max_range_m=12.0, T_base_laser=(0.2, 0.0, 0.0))
        with fcslam.Robot("anna", laser) as robot:
            for ranges_m, stamp, odometry in my_driver():
                pose = robot.add_scan(ranges_m, stamp, odometry)
                print(pose.x, pose.y, pose.theta)
            robot.finish()
            robot.save("runs/anna")

    Add records from one thread at a time, in the order of their stamps; every other method may be called from any
    thread. The robot starts a process: a script needs ``if __name__ == "__main__":`` around its own code, as always
    with Python's ``multiprocessing``.
    """

    def __init__(
        self,
        name: str,
        laser: Lasers | None = None,
        *,
        config: MissionConfig | Mapping[str, Any] | StrPath | None = None,
        on_event: Callable[[RobotEvent], None] | None = None,
        executor: Executor | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the robot; takes some seconds, after which the first scan is as quick as every other.

        Args:
            name: of the robot; letters, digits and ``. _ -``.
            laser: its LiDAR, or several by name. None: only ``add`` is used.
            config: as in ``map_recordings``.
            on_event: called by ``add_scan``, ``add_image`` and ``add``, in their thread, before they return.
            executor: runs the back end and the map, in its only worker. None: a process of its own, which ends with the
                robot.
            clock: seconds of any origin, for the age of corrections.

        Raises:
            InputError: the name, a laser or the configuration cannot be used, or the worker does not start.
        """
        self.name = checked_robot(name)
        self._lasers = checked_lasers(laser)
        self._config = settings_of(config)
        self._on_event = on_event
        self._clock = clock
        self._lock = threading.RLock()
        self._newest_s = -math.inf
        self._scans = 0
        self._pose: RobotPose | None = None
        self._newest_part = 0
        """The part that the newest pose is of."""
        self._applied: Correction | None = None
        """The correction that the newest pose was made with."""
        self._is_finished = self._is_closed = False
        self._told: set[str] = set()
        """Failures that were told."""
        self._own: dict[int, Localizer] = {}
        """The robot's own corrections, by part: after being lost, the robot goes on in another part."""
        self._owned = executor is None
        self._executor = worker_process() if executor is None else executor
        try:
            self._map = OwnMap(name, self._config, self._executor, self._correct)
            self._frontend = RobotFrontend(name, self._config.robot, Beside(name, self._config.robot, self._executor))
        except BrokenExecutor as error:
            raise InputError(
                f"{name}: the process of the back end does not start; a script that makes a Robot needs "
                '`if __name__ == "__main__":` around its own code'
            ) from error
        warm_up_tracking(self._config.robot)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def add_scan(self, ranges_m: ArrayLike, stamp: float, odometry: ArrayLike, laser: str = "") -> RobotPose:
        """Localize the next scan.

        Args:
            ranges_m: metres, shape (beam_count,). NaN or negative: invalid; inf, or at least ``max_range_m``: no
                return.
            stamp: seconds. It may step back by 2 s at most, as clocks of several sensors disagree.
            odometry: pose (x, y, theta) of ``base`` by wheel odometry at the stamp, metres and radians; its origin does
                not matter.
            laser: which one, if there are several.

        Returns:
            Where the robot is.

        Raises:
            InputError: the ranges do not fit the laser, the clock went back by more than 2 s, a number cannot be used,
                or the robot is finished. The scan is ignored, and the next one may be added.
        """
        if laser not in self._lasers:
            raise InputError(f"laser {laser!r} is not known; known: {', '.join(map(repr, self._lasers)) or 'none'}")
        with self._lock:
            scan = checked_scan(ranges_m, stamp, odometry, self._lasers[laser], self._newest_s)
            return self._process(scan)

    def add(self, record: SensorRecord) -> RobotPose | None:
        """Add the next record of any sensor, as a recording yields them; returns the pose of a scan.

        The caller vouches for the record: unlike ``add_scan``, this checks nothing.

        Raises:
            InputError: the robot is finished.
        """
        with self._lock:
            if isinstance(record, LaserScan):
                return self._process(record)
            self._require_unfinished()
            self._take(self._frontend.process(record))
            return None

    @property
    def pose(self) -> RobotPose | None:
        """The pose of the newest scan; None before the first."""
        return self._pose

    def map(self) -> OccupancyMap:
        """The map that the robot is in, of all scans added so far, corrected by all loop closures.

        It takes tens of milliseconds to seconds, in the worker; other threads may add scans meanwhile.

        Returns:
            The occupancy of each cell, shape (H, W), the side of a cell and the lower left corner in ``map``.

        Raises:
            FcslamError: the worker has ended.
        """
        self._catch_up()
        return self._map.draw(session_name(self.name, self._part), np.zeros(3))

    def trajectory(self) -> RobotTrajectory:
        """All scans since the robot was last lost, corrected by all loop closures so far; it waits for the worker.

        Raises:
            FcslamError: the worker has ended.
        """
        self._catch_up()
        with self._lock:
            part = self._part
            track = self._frontend.tracks[part]
            stamps, keyscans, offsets = track.stamps, track.keyscans, track.T_keyscan_base
            T_odom_keyscan = track.T_odom_keyscan
        known = self._map.poses(session_name(self.name, part))
        T_map_odom = (
            np.zeros(3) if not len(known) else se2.compose(known[-1], se2.inverse(T_odom_keyscan[len(known) - 1]))
        )
        poses = np.concatenate((known, se2.compose(T_map_odom, T_odom_keyscan[len(known) :])))
        index = self._localizer(part).map_index
        T_map_base = se2.compose(poses[keyscans], offsets)
        return RobotTrajectory(
            session_name(self.name, part), 0 if index is None else index, frozen(stamps), frozen(T_map_base)
        )

    def finish(self) -> None:
        """End the recording: close the last loops. Nothing can be added after it."""
        with self._lock:
            if not self._is_finished:
                self._is_finished = True
                self._take(self._frontend.finish())

    def save(self, folder: StrPath, force: bool = False) -> Run:
        """Write a run folder, as ``fcslam map`` does; after ``finish`` it is the same as for a recording.

        Args:
            folder: the folder to make.
            force: replace a run that is there.

        Returns:
            What was written.

        Raises:
            OutputError: the folder cannot be written.
            FcslamError: the worker has ended.
        """
        prepare_output(Path(folder), force)
        with self._lock:
            self._take(self._frontend.ready(wait=True))  # a run needs the keyscans of all its scans
            tracks = {
                session_name(self.name, part): track_of(track) for part, track in enumerate(self._frontend.tracks)
            }
        stamps = np.concatenate([track.stamps for track in tracks.values()])
        run = self._map.run(tracks, len(stamps), float(np.ptp(stamps)) if len(stamps) else 0.0)
        run.save(folder, force)
        return run

    def close(self) -> None:
        """Finish, and end the worker. A second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self.finish()
        finally:
            if self._owned:
                self._executor.shutdown(cancel_futures=True)

    @property
    def _part(self) -> int:
        return len(self._frontend.tracks) - 1

    def _require_unfinished(self) -> None:
        if self._is_finished:
            raise InputError(f"{self.name}: the robot is finished; make a new Robot to go on")

    def _catch_up(self) -> None:
        """Wait, without keeping scans waiting, until the back end has handled everything so far."""
        with self._lock:
            output = self._frontend.newest_output
        if output is not None:
            wait([output])
        with self._lock:
            self._take(self._frontend.ready())

    def _process(self, scan: LaserScan) -> RobotPose:
        """Localize a scan, and tell what happened."""
        self._require_unfinished()
        self._take(self._frontend.process(scan))
        self._newest_s = max(self._newest_s, scan.stamp)
        self._scans += 1
        pose = self._pose = self._pose_of(self._newest(), scan.T_odom_base)
        self._tell()
        return pose

    def _take(self, packets: list[Packet]) -> None:
        """Pass the next packets on."""
        self._map.put(packets)

    def _correct(self, epoch: int, correction: Correction) -> None:
        """Take a correction of the robot's own map, in any thread."""
        self._localizer(epoch).correct(correction)

    def _localizer(self, part: int) -> Localizer:
        return self._own.setdefault(part, Localizer(self._clock))

    def _pose_of(self, newest: NewestScan, T_odom_base: FloatArray) -> RobotPose:
        localizer = self._localizer(self._part)
        T_smooth_base = self._frontend.scan_poses.in_odom(newest.pose)
        corrected = localizer.T_map_base(T_smooth_base)
        is_found = self._part == 0 or localizer.quality > 0.0
        return RobotPose(
            newest.pose.stamp, frozen(T_smooth_base if corrected is None else corrected), T_odom_base, newest.quality,
            is_found and not newest.is_deferred, localizer.map_index, newest.pose.T_keyscan_base, newest.tracked,
            self._config.robot.lidar.tracker.odometry,
        )  # fmt: skip

    def _tell(self) -> None:
        """Tell what happened between two scans."""
        part, correction = self._part, self._localizer(self._part).correction
        if part > self._newest_part:
            self._newest_part, self._applied = part, None
            self._event(EventKind.LOST, "lost: the scans contradict the map; the robot maps in a new session")
        if correction is not self._applied and correction is not None:
            self._tell_correction(self._applied, correction)
            self._applied = correction
        for failure in (self._frontend.backend_failure, self._map.failure):
            if failure is not None and failure not in self._told:
                self._told.add(failure)
                self._event(EventKind.FAILED, f"no loop closures from now on, as the back end failed: {failure}")

    def _tell_correction(self, before: Correction | None, now: Correction) -> None:
        if self._part > 0 and now.quality > 0.0 and (before is None or before.quality == 0.0):
            self._event(EventKind.RELOCALISED, f"relocalised in map {now.map_index}, quality {now.quality:.2f}")
        elif before is not None and now.map_index != before.map_index:
            self._event(EventKind.JOINED, f"now in map {now.map_index}")
        T_smooth_base = self._frontend.scan_poses.in_odom(self._newest().pose)
        T_map_before = np.zeros(3) if before is None else before.T_map_odom
        moved = se2.between(se2.compose(T_map_before, T_smooth_base), se2.compose(now.T_map_odom, T_smooth_base))
        distance_m, turned_rad = float(np.hypot(moved[0], moved[1])), abs(float(moved[2]))
        if distance_m > JUMP_M or turned_rad > JUMP_RAD:
            self._event(EventKind.CORRECTED, f"corrected by {distance_m:.3f} m and {turned_rad:.4f} rad")

    def _event(self, kind: EventKind, text: str) -> None:
        level = logging.INFO if kind is EventKind.CORRECTED else logging.WARNING
        _log.log(level, "%s: %s", self.name, text)
        if self._on_event is not None:
            self._on_event(RobotEvent(kind, self._newest_s, text))

    def _newest(self) -> NewestScan:
        newest = self._frontend.newest
        assert newest is not None  # there is one after a scan
        return newest
