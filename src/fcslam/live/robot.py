"""A robot that maps live: scans in, its pose in the map out.

The tracker runs in the thread that adds a scan. All else, loop closing, the map and place recognition, runs in a worker
beside it, which is another process, so no pose waits for it.
"""

import math
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Executor
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fcslam.api import settings_of
from fcslam.cloud.sessions import session_name
from fcslam.errors import InputError, PacketError
from fcslam.geometry.groups import SE2, by_dimensions, compose, group_of, to_space
from fcslam.lidar.frontend import ODOMETRY_SIGMA_M, ODOMETRY_SIGMA_RAD
from fcslam.live.fleet_view import FleetView
from fcslam.live.inputs import Lasers, checked_camera, checked_image, checked_stamp
from fcslam.live.joint_map import JointMap
from fcslam.live.map_poses import MapPoses
from fcslam.live.own_map import OwnMap
from fcslam.live.records import WIRED, EventKind, RobotEvent, RobotPose, RobotStatus, Wiring
from fcslam.live.tracker import LiveTracker
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.mission.driving import track_of
from fcslam.mission.mission import MissionConfig
from fcslam.records import (
    CameraModel,
    CloudScan,
    Correction,
    FloatArray,
    Keyscan,
    LaserScan,
    SensorRecord,
    StrPath,
    checked_pose,
    frozen,
)
from fcslam.robot.backend_runner import in_worker
from fcslam.robot.frontend import NewestScan, RobotFrontend
from fcslam.robot.keyframe_folder import KEYFRAMES
from fcslam.robot.outbox import Outbox
from fcslam.robot.sender import CONNECTING, SEND_INTERVAL_S
from fcslam.robot.uplink import Uplink
from fcslam.runs import RobotTrajectory, Run, prepare_output
from fcslam.warmup import warm_up_space, warm_up_tracking
from fcslam.wire.checks import check_floor
from fcslam.wire.fleet_client import FleetClient
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.keys import Server
from fcslam.wire.messages import Packet

if TYPE_CHECKING:
    from fcslam.robot.frontend3d import NewestTurn

EVENT_M, EVENT_RAD = ODOMETRY_SIGMA_M, ODOMETRY_SIGMA_RAD
"""Corrections that move the robot by less are not events."""

POLL_INTERVAL_S = 0.1
"""Interval at which ``finish`` looks whether the server has everything."""
LARGEST_BACKLOG = 200
"""Largest number of inputs that wait for the back end or the disk, or of blocks of packets that wait for the map, while
a recording is played; a robot in real time never has as many."""

LARGEST_OUTBOX_BYTES = 256_000_000
"""Limit of the packets that wait for the server; above three quarters, places are left out."""


class Robot(LiveTracker):
    """One robot that maps while it drives.

        one_degree = math.radians(1.0)
        laser = fcslam.LaserModel(360, -math.pi, one_degree, max_range_m=12.0, T_base_laser=(0.2, 0.0, 0.0))
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
        camera: CameraModel | None = None,
        server: str | Server | None = None,
        state: StrPath | None = None,
        config: MissionConfig | Mapping[str, Any] | StrPath | None = None,
        own_map: bool = True,
        floor: str = "",
        lidar_3d: bool = False,
        on_event: Callable[[RobotEvent], None] | None = None,
        wiring: Wiring = WIRED,
    ) -> None:
        """Start the robot; takes some seconds, after which the first scan is as quick as every other.

        Args:
            name: of the robot; letters, digits and ``. _ -``.
            laser: its LiDAR, or several by name. None: only ``add`` is used.
            camera: its camera, if it has one.
            server: the `fcslam serve` of the robot's fleet: its address, or a ``Server`` with token, certificates and
                limit. None: the robot maps alone.
            state: folder of this robot alone, for the packets that its server has not confirmed. None: nothing is kept.
            config: as in ``map_recordings``.
            own_map: whether the robot has a map of its own; a robot with a server may do without.
            floor: floor of the building, 1 to 16 letters, digits and ``. _ + -``. Places of different floors are never
                compared. Empty: none is named.
            lidar_3d: whether the robot has a 3D LiDAR. ``add`` then takes ``CloudScan`` records, and poses have six
                degrees of freedom. The configuration needs ``fleet.dimensions`` 3.
            on_event: called by ``add_scan``, ``add_image`` and ``add``, in their thread, before they return.
            wiring: for fcslam's own commands and tests.

        Raises:
            InputError: the name, a laser, the configuration, the floor, the address, a file or the state folder cannot
                be used, or the worker does not start.
        """
        _check_floor(floor)
        super().__init__(name, laser, settings_of(config), on_event)
        if lidar_3d and self._config.fleet.group is SE2:
            raise InputError(f"{self.name}: a 3D LiDAR needs a map in space; set fleet.dimensions to 3 (--3d)")
        if lidar_3d and (camera is not None or wiring.keeps_keyframes):
            raise InputError(f"{self.name}: a robot with a 3D LiDAR uses no camera; leave out camera= (--learn)")
        self._camera = checked_camera(camera)
        self._clock = wiring.clock
        self._newest_session = 0
        """The session that the newest pose is of."""
        self._applied: Correction | None = None
        """The correction that the newest pose was made with."""
        self._map_poses = MapPoses(wiring.clock)
        self._keyscans = 0
        self._is_placed = False
        """Whether the poses of all keyframes are written."""
        self._is_online: bool | None = None
        """Whether the server can be reached; None before the first reply."""
        self._sleep = wiring.sleep
        self.fleet: FleetView | None = None
        """What the robot knows of its fleet; None without a server or without a map of its own."""
        self._uplink: Uplink | None = None
        self._joint: JointMap | None = None
        self._news = 0
        """Changes of the fleet that were told."""
        with ExitStack() as stack:
            executor = self._executor = wiring.started(stack)
            access = Server(server) if isinstance(server, str) else server
            sends = access is not None or wiring.transport is not None
            folder = _state_folder(state, sends or wiring.keeps_keyframes, stack)
            # It refuses the folder of another robot or process, so it is opened before anything is deleted.
            outbox = None
            if sends and folder is not None:
                outbox = stack.enter_context(closing(Outbox(folder / "outbox.sqlite", self.name, LARGEST_OUTBOX_BYTES)))
            keyframes = _keyframe_folder(folder, wiring.resumes) if wiring.keeps_keyframes else None
            self._start(executor, own_map, keyframes, lidar_3d)
            self._frontend.change_floor(floor)
            if outbox is not None and folder is not None:
                self._uplink = self._connect(access, outbox, folder, wiring, own_map, stack)
            if lidar_3d:
                warm_up_space()
            else:
                warm_up_tracking(self._config.robot)
            self._stack = stack.pop_all()

    def add_image(self, image: ArrayLike, stamp: float, odometry: ArrayLike | None = None) -> None:
        """Add the next image of the camera, by which places are recognised. It never leaves the robot.

        Args:
            image: undistorted, shape (height, width), or (height, width, 3) in the order red, green, blue; uint8.
            stamp: seconds, as in ``add_scan``.
            odometry: as in ``add_scan``, at the stamp of the image. None: the pose is that of the last scan.

        Raises:
            InputError: the robot has no camera, or the image, the stamp or the odometry cannot be used.
        """
        if self._camera is None:
            raise InputError(f"{self.name}: the robot has no camera; give camera=fcslam.CameraModel(...)")
        with self._lock:
            stamp = checked_stamp(stamp, self._newest_s)
            T_odom_base = None if odometry is None else checked_pose("odometry", odometry)
            self.add(checked_image(image, stamp, T_odom_base, self._camera))

    def change_floor(self, floor: str) -> None:
        """Begin a new session on another floor; call it after a ride in a lift, before the first scan there.

        Args:
            floor: name of the floor, 1 to 16 letters, digits and ``. _ + -``.
        """
        _check_floor(floor)
        with self._lock:
            self._require_unfinished()
            self._frontend.change_floor(floor)

    def status(self) -> RobotStatus:
        """Return the state of the robot: its place in the map, its connection, and counts since its start."""
        uplink, localizer, tracks = self._uplink, self._map_poses.localizer(self._session), self._frontend.tracks
        failure = self._frontend.packets.failure
        broken = f"no closures and places from now on, as the back end failed: {failure}" if failure else None
        jumps = "the odometry jumps; scan matching bridges it" if self.odometry_jumps else None
        unused = self._config.robot.unused_in_space if self._frontend.scans is CloudScan else None
        status = RobotStatus(
            scans=self._scans,
            keyscans=self._keyscans,
            map_index=localizer.map_index,
            correction_age_s=localizer.age_s,
            quality=localizer.quality,
            times_lost=self._session - max(session for session, track in enumerate(tracks) if track.is_new_floor),
            notices=tuple(filter(None, (*(uplink.notices if uplink else ()), broken, jumps, unused))),
        )
        if uplink is None:
            return status
        sender = uplink.sender
        return replace(
            status,
            waiting=uplink.outbox.waiting,
            confirmed=sender.confirmed,
            sent_bytes=sender.sent_bytes,
            left_out=uplink.left_out,
            refused=sender.refusals,
            trouble=sender.trouble,
            is_catching_up=uplink.is_catching_up,
        )

    def map(self) -> OccupancyMap:
        """The map that the robot is in: with a server its fleet's joint map, with what the robot saw lately drawn in.

        Without a server, and before it has drawn the map that the robot is in, it is ``own_map``. While the server is
        away, it is the newest joint map with all that the robot has seen since.
        """
        joint = self.joint_map()
        return self.own_map() if joint is None else joint

    def joint_map(self) -> OccupancyMap | None:
        """As ``map``; None instead of ``own_map``."""
        if self._joint is None:
            return None
        with self._lock:
            session = self._session
            track = self._frontend.tracks[session]
        return self._joint.draw(session, track, self._map_poses.localizer(session))

    def own_map(self) -> OccupancyMap:
        """The map of all that this robot has seen so far, corrected by all loop closures.

        It takes tens of milliseconds to seconds, in the worker; other threads may add scans meanwhile. With a server it
        is in the frame of the fleet's map.
        """
        own = self._require_own_map()
        self._catch_up()
        return own.draw(*self._in_own_map())

    def points(self) -> FloatArray | None:
        """The map in space that the robot is in: a point for each voxel, shape (N, 3), metres in ``map``.

        With a server it is the joint map, which takes time to come. None: the map is in the plane, or not there yet.
        """
        if self._config.fleet.group is SE2:
            return None
        if self.fleet is not None:
            return self.fleet.points()
        self._catch_up()
        return self._require_own_map().points(*self._in_own_map())

    def closures(self) -> FloatArray:
        """Both ends of each loop closure that holds in the robot's map, shape (N, 2, 2), metres in ``map``."""
        return self._require_own_map().closures(*self._in_own_map())

    def trajectory(self) -> RobotTrajectory:
        """All scans since the robot was last lost or changed its floor; it waits for the worker.

        All loop closures so far correct the poses; without a map of its own, the server's newest correction moves them.
        """
        self._catch_up()
        with self._lock:
            session = self._session
            track = self._frontend.tracks[session]
            stamps, keyscans, offsets = track.stamps, track.keyscans, track.T_keyscan_base
            T_odom_keyscan = track.T_odom_keyscan
        known = T_odom_keyscan[:0] if self._own is None else self._own.poses(session_name(self.name, session))
        # The map may have got keyscans since the track was read.
        known = compose(self._map_poses.T_map_own(session), known[: len(T_odom_keyscan)])
        # Keyscans that the map does not have yet go on from the last one that it has.
        group = group_of(T_odom_keyscan)
        moved = self._map_poses.localizer(session).T_map_base(group.identity)
        T_map_odom = group.identity if moved is None else moved
        if len(known):
            T_map_odom = compose(known[-1], group.inverse(T_odom_keyscan[len(known) - 1]))
        rest = compose(T_map_odom, T_odom_keyscan[len(known) :])
        poses = np.concatenate((known, rest)) if len(known) else rest
        index = self._map_poses.localizer(session).map_index
        T_map_base = compose(poses[keyscans], offsets)
        planar, in_space = by_dimensions(T_map_base)
        return RobotTrajectory(
            session_name(self.name, session),
            0 if index is None else index,
            frozen(stamps),
            planar,
            track.floor,
            in_space,
        )

    def finish(self, timeout_s: float | None = None, watch: Callable[[RobotStatus], None] | None = None) -> bool:
        """End the recording: close the last loops and wait until the server has everything. Then nothing can be added.

        Args:
            timeout_s: longest time to wait for the server, seconds; None: as long as it takes.
            watch: called while it waits.

        Returns:
            Whether the server has everything; otherwise the rest waits in the state folder for the next start.

        Raises:
            CloudError: the server rejects the robot.
            InputError: the state folder cannot be used.
        """
        with self._lock:
            if not self._is_finished:
                self._is_finished = True
                self._take(self._frontend.finish())
                self._tell_examined()
                if self._own is not None:
                    self._own.hand_over()
        until_s = math.inf if timeout_s is None else self._clock() + timeout_s
        uplink = self._uplink
        if uplink is None:
            return True
        while (uplink.unstored or uplink.outbox.waiting.packets) and self._clock() < until_s and not self._is_closed:
            self._wait_once(watch)
        self._raise_failure()
        return not uplink.unstored and not uplink.outbox.waiting.packets

    def idle(self) -> None:
        """Write where the keyframes are, for a process that learns from them, and take a detector that the server
        announced meanwhile. Call it while no scan is due.
        """
        self._raise_failure()
        with self._lock:
            if not self._is_placed and not self._is_finished:
                self._frontend.place_keyframes()
                self._is_placed = True
            if self._uplink is not None:
                self._uplink.between_records()
            self._take(self._frontend.ready())

    def wait_for_room(self, watch: Callable[[RobotStatus], None] | None = None) -> None:
        """Wait until back end, map, disk and server can take more: for programs that add records faster than robots."""
        self._raise_failure()
        while self._is_behind() and not self._is_closed:
            self._wait_once(watch)

    def save(self, folder: StrPath, force: bool = False) -> Run:
        """Write a run folder of the robot's own map, as ``fcslam map`` does, and return the run; after ``finish`` it is
        the same as for a recording.

        Args:
            folder: the folder to make.
            force: replace a run that is there.
        """
        own = self._require_own_map()
        prepare_output(Path(folder), force)
        with self._lock:
            self._take(self._frontend.ready(wait=True))  # a run needs the keyscans of all its scans
            sessions = enumerate(self._frontend.tracks)
            tracks = {session_name(self.name, session): track_of(track) for session, track in sessions if len(track)}
        if not tracks:
            raise InputError(f"{self.name}: no scan was added, so there is no map to save")
        stamps = np.concatenate([track.stamps for track in tracks.values()])
        run = own.run(tracks, len(stamps))
        run.save(folder, force)
        return run

    def _start(self, executor: Executor, own_map: bool, keyframes: Path | None, lidar_3d: bool) -> None:
        robot = self._config.robot
        try:
            self._own = OwnMap(self.name, self._config, executor, self._correct) if own_map else None
            if lidar_3d:
                from fcslam.robot.frontend3d import RobotFrontend3d  # robots with 2D LiDARs have no use for it

                self._frontend = RobotFrontend3d(self.name, robot)
                return
            backend = in_worker(self.name, robot, executor, keyframes)
            self._frontend = RobotFrontend(self.name, robot, backend, self._mark_teammates)
        except BrokenExecutor as error:
            raise InputError(
                f"{self.name}: the process of the back end does not start; a script that makes a Robot needs "
                '`if __name__ == "__main__":` around its own code'
            ) from error

    def _connect(
        self, access: Server | None, outbox: Outbox, folder: Path, wiring: Wiring, follows_fleet: bool, stack: ExitStack
    ) -> Uplink:
        transport, budget_kBps = wiring.transport, None
        if access is not None:
            budget_kBps = access.budget_kBps
            transport = stack.enter_context(closing(HttpTransport(access, self.name, outbox.agent)))
            if follows_fleet:
                self.fleet = FleetView(FleetClient(access), self.name, self._place, budget_kBps)
                stack.enter_context(closing(self.fleet)).start()
                self._joint = JointMap(self.fleet, self._config.map)
        assert transport is not None
        uplink = Uplink(
            self._frontend,
            outbox,
            transport,
            folder,
            np.random.default_rng(),  # not the seed of the configuration: robots must not retry at the same moments
            self._clock,
            self._map_poses.correct_by_server,
            outbox.begin(wiring.recording, wiring.resumes),
            budget_kBps,
        )
        stack.callback(uplink.close)
        return uplink

    def _require_own_map(self) -> OwnMap:
        if self._own is None:
            raise InputError(f"{self.name}: the robot was made without a map of its own; give own_map=True")
        return self._own

    def _in_own_map(self) -> tuple[str, FloatArray]:
        """Name of the present session, and the pose of the robot's own map in ``map``."""
        with self._lock:
            session = self._session
        return session_name(self.name, session), self._map_poses.T_map_own(session)

    def _is_behind(self) -> bool:
        uplink, own = self._uplink, self._own
        unstored, is_full = (0, False) if uplink is None else (uplink.unstored, uplink.outbox.is_full)
        with self._lock:
            behind = max(self._frontend.packets.backlog, unstored, 0 if own is None else own.backlog) > LARGEST_BACKLOG
            if behind:
                self._take(self._frontend.ready())
        return behind or is_full

    def _wait_once(self, watch: Callable[[RobotStatus], None] | None) -> None:
        self._raise_failure()
        if watch is not None:
            watch(self.status())
        self._sleep(POLL_INTERVAL_S)

    def _raise_failure(self) -> None:
        if self._uplink is not None and self._uplink.failure is not None:
            raise self._uplink.failure

    def _catch_up(self) -> None:
        """Wait, without keeping scans waiting, until the back end has handled everything so far."""
        with self._lock:
            output = self._frontend.packets.newest
        if output is not None:
            with suppress(Exception):  # it is told elsewhere; ``wait`` would wait for a cancelled output for ever
                output.exception()
        with self._lock:
            self._take(self._frontend.ready())

    def _processed(self, record: SensorRecord) -> list[Packet]:
        self._is_placed = False
        if self._uplink is not None and not self._is_finished:
            self._uplink.before_record()
        return super()._processed(record)

    def _mark_teammates(self, scan: LaserScan) -> LaserScan:
        return scan if self._joint is None else self._joint.mark_teammates(scan, self._session, self._pose)

    def _take(self, packets: list[Packet]) -> None:
        if not packets:
            return
        self._keyscans += sum(isinstance(packet.body, Keyscan) for packet in packets)
        if self._joint is not None:
            self._joint.add(packets)
        if self._uplink is not None:
            self._uplink.put(packets)
        if self._own is not None:
            self._own.put(packets)

    def _place(self) -> tuple[int, FloatArray] | None:
        pose = self._pose
        return None if pose is None or pose.map_index is None else (pose.map_index, pose.T_map_base)

    def _correct(self, session: int, correction: Correction) -> None:
        is_server_away = self._uplink is None or self._uplink.sender.trouble is not None
        self._map_poses.correct(session, correction, is_server_away)

    def _pose_of(
        self, newest: "NewestScan | NewestTurn", T_smooth_base: FloatArray, T_odom_base: FloatArray | None
    ) -> RobotPose:
        localizer = self._map_poses.localizer(self._session)
        corrected = localizer.T_map_base(T_smooth_base)
        is_found = self._frontend.scan_poses.is_new_floor or localizer.quality > 0.0
        planar, in_space = by_dimensions(T_smooth_base if corrected is None else corrected)
        return RobotPose(
            newest.pose.stamp,
            planar,
            T_odom_base,
            newest.quality,
            is_found and not newest.is_deferred,
            localizer.map_index,
            self._frontend.belief,
            np.zeros((3, 3)),
            in_space,
        )

    def _tell(self) -> None:
        session, correction = self._session, self._map_poses.localizer(self._session).correction
        if session > self._newest_session:
            self._newest_session, self._applied = session, None
            track = self._frontend.scan_poses
            if track.is_new_floor:
                where = f"floor {track.floor}" if track.floor else "a floor without a name: it rode in a lift; name it"
                self._event(EventKind.FLOOR, f"in a new session, on {where}")
            else:
                self._event(
                    EventKind.LOST,
                    "lost: the scans contradict the map, or stopped while it drove on; the robot maps in a new session",
                )
        if correction is not self._applied and correction is not None:
            self._tell_correction(self._applied, correction)
            self._applied = correction
        self._tell_connection()
        if self.fleet is not None:
            for line in self.fleet.news[self._news :]:
                self._news += 1
                self._event(EventKind.FLEET, line)
        if self._own is not None:
            self._own.hand_over(self._newest_s - SEND_INTERVAL_S)
        broken = self._frontend.packets.failure, None if self._own is None else self._own.failure
        for failure in filter(None, broken):
            self._tell_failure(f"no loop closures from now on, as the back end failed: {failure}")

    def _tell_connection(self) -> None:
        if self._uplink is None:
            return
        if self._uplink.failure is not None:
            what = "sent" if self._uplink.failure is self._uplink.sender.failure else "sent or kept"
            self._tell_failure(f"nothing is {what} any more: {self._uplink.failure}")
        sender, was_online = self._uplink.sender, self._is_online
        if sender.trouble is None and was_online is not True and sender.confirmed:
            self._is_online = True
            self._event(EventKind.ONLINE, "the server confirms packets")
        elif sender.trouble not in (None, CONNECTING) and was_online is not False:
            self._is_online = False
            self._event(EventKind.OFFLINE, f"the robot goes on, and its packets wait: {sender.trouble}")

    def _tell_correction(self, before: Correction | None, now: Correction) -> None:
        is_new_floor = self._frontend.scan_poses.is_new_floor
        if not is_new_floor and now.quality > 0.0 and (before is None or before.quality == 0.0):
            self._event(EventKind.RELOCALIZED, f"relocalized in map {now.map_index}, quality {now.quality:.2f}")
        elif (before is None and self._uplink is not None) or (before and now.map_index != before.map_index):
            self._event(EventKind.JOINED, f"now in map {now.map_index}")
        T_smooth_base = self._frontend.scan_poses.in_odom(self._newest().pose)
        T_map_before = SE2.identity if before is None else before.T_map_odom
        after = compose(now.T_map_odom, T_smooth_base)
        group = group_of(after)
        earlier = compose(T_map_before, T_smooth_base)
        moved = group.between(earlier if group is SE2 else to_space(earlier), after)
        distance_m, turned_rad = float(group.shift_m(moved)), float(group.turn_rad(moved))
        if distance_m > EVENT_M or turned_rad > EVENT_RAD:
            self._event(EventKind.CORRECTED, f"corrected by {distance_m:.3f} m and {turned_rad:.4f} rad")


def _check_floor(floor: str) -> None:
    try:
        if floor:
            check_floor(floor)
    except PacketError as error:
        raise InputError(str(error)) from error


def _keyframe_folder(state: Path | None, resumes: bool) -> Path:
    if state is None:
        raise InputError("a robot that learns keeps keyframes; give --state, in Python state=")
    folder = state / KEYFRAMES
    if not resumes:
        shutil.rmtree(folder, ignore_errors=True)
    return folder


def _state_folder(given: StrPath | None, is_needed: bool, stack: ExitStack) -> Path | None:
    if given is None:
        return Path(stack.enter_context(TemporaryDirectory(prefix="fcslam-"))) if is_needed else None
    folder = Path(given)
    if not is_needed:
        raise InputError(f"{folder}: a robot without a server keeps nothing; give --server, or leave out --state")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made ({error.strerror}); give another folder: --state, in Python state="
        ) from error
    return folder
