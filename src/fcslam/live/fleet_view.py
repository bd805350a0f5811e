"""What a live robot knows of its fleet: the joint map and its quality, where the others are, and where to explore.

A thread follows the cloud. No scan waits for it, and while the cloud is away everything stays as it was last.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from fcslam.errors import FcslamError, UnavailableError
from fcslam.maps.joint_tiles import LARGEST_ANSWER, TiledMap, decode_batch
from fcslam.maps.joint_voxels import read_points
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import FloatArray
from fcslam.robot.sender import ASK_AFTER_S, retry_delay_s
from fcslam.robot.uplink import STOP_TIMEOUT_S
from fcslam.wire.fleet_client import FleetClient
from fcslam.wire.fleet_replies import FleetReply, MapFrontiers, QualityReply, TeammatePose

POLL_S: Final = 0.5
"""Time between two looks at the fleet."""
DOWNLINK_KB_PER_S: Final = 15.0
"""Limit of the tiles, kB per second, without a budget."""


class FleetView:
    """Follows the fleet of one robot. Any thread may call."""

    def __init__(
        self,
        client: FleetClient,
        robot: str,
        own_pose: Callable[[], tuple[int, FloatArray] | None],
        limit_kBps: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Follow nothing before ``start``; ``close`` closes the client.

        ``own_pose`` gives the index of the robot's map and its pose there, if both are known. ``limit_kBps``
        limits the tiles; None: ``DOWNLINK_KB_PER_S``.
        """
        self._client, self._robot, self._own_pose, self.clock = client, robot, own_pose, clock
        self._rng = np.random.default_rng()  # robots must not retry at the same moments
        self._limit_bytes = min(max(1, int(1e3 * POLL_S * (limit_kBps or DOWNLINK_KB_PER_S))), LARGEST_ANSWER)
        self._tiled, self._etag = TiledMap(), ""
        self._reply: tuple[FleetReply, float] | None = None
        """The newest one and when it came."""
        self.joint_map: OccupancyMap | None = None
        """The joint map of the newest tiles, in its own frame; None before all tiles of that frame came."""
        self._is_settling = False
        """In a new frame, some tiles are missing yet."""
        self.drawn_s = -np.inf
        """Stamp of the robot's newest keyscan that is in ``joint_map``; minus infinity without one."""
        self.news: list[str] = []
        """What changed in the robot's map, one line each, the oldest first."""
        self.version = 0
        """Grows with every change of the joint map."""
        self.frontiers: tuple[MapFrontiers, ...] = ()
        """Where the robot's map can be explored further, and who shall go where."""
        self.quality: tuple[QualityReply, ...] = ()
        """How good the robot's map is; empty before the cloud has computed its certificate."""
        self._advised_s = -np.inf
        self._points: FloatArray | None = None
        self._points_etag, self._points_due_s = "", np.inf
        self.trouble: str | None = None
        """Why the cloud cannot be followed; None if it can."""
        self._failures = 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to follow, in a thread."""
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop following."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(STOP_TIMEOUT_S)
        self._client.close()

    @property
    def received_bytes(self) -> int:
        """Bytes of the cloud's replies so far."""
        return self._client.received_bytes

    @property
    def map_index(self) -> int | None:
        """Index of the map that the robot is in, as the cloud draws it; None if it is in none."""
        reply = () if self._reply is None else self._reply[0].robots
        return next((one.map_index for one in reply if one.robot == self._robot), None)

    def points(self) -> FloatArray | None:
        """The newest points of the joint map in space, shape (N, 3), in ``map``; None before the first came.

        They are large, so they come from the first call on, as often as the limit of the tiles allows.
        """
        self._points_due_s = min(self._points_due_s, self.clock())
        return self._points

    def teammates(self, map_index: int | None) -> FloatArray:
        """The other robots in a map: x and y there, metres, and the age of the pose, seconds; shape (N, 3)."""
        others = [one for one in self.robots() if one.map_index == map_index and one.robot != self._robot]
        return np.array([(*one.T_map_base[:2], one.age_s) for one in others], np.float64).reshape(-1, 3)

    def robots(self) -> list[TeammatePose]:
        """All robots that the cloud knows, with the ages of their poses now."""
        if self._reply is None:
            return []
        reply, came_s = self._reply
        since_s = self.clock() - came_s
        return [one.model_copy(update={"age_s": one.age_s + since_s}) for one in reply.robots]

    def step(self) -> None:
        """Ask once."""
        client, own = self._client, self._own_pose()
        pose = None if own is None or not np.isfinite(own[1]).all() else tuple(own[1].tolist())
        reply = client.exchange(self._robot, None if own is None else own[0], pose), self.clock()
        stamp = next((one.stamp for one in reply[0].robots if one.robot == self._robot), -np.inf)
        found = client.tiles(self._robot, self._etag, self._limit_bytes)
        is_complete = True
        if found is not None:
            try:
                batch = decode_batch(found[0])
                is_new = batch.frame != self._tiled.frame
                self._tiled.add(batch)
                is_complete = batch.is_complete
            except ValueError as error:
                self._etag = ""
                raise UnavailableError(f"the cloud's reply is broken: {error}") from error
            self._etag = found[1]
            self._is_settling = (self._is_settling or is_new) and not is_complete
            self.joint_map = None if self._is_settling else self._tiled.occupancy()
            self.version += 1
        before = self._in_map()
        self._reply = reply
        self._tell(before, self._in_map())
        if is_complete:  # the poses came before the tiles, so the tiles hold at least this keyscan
            self.drawn_s = stamp
        if self.clock() - self._advised_s >= ASK_AFTER_S:
            self._advised_s = self.clock()
            self.frontiers, self.quality = client.frontiers(self._robot), client.quality(self._robot)
        if self.clock() >= self._points_due_s:
            self._ask_for_points()

    def _ask_for_points(self) -> None:
        before = self._client.received_bytes
        self._points_due_s = self.clock() + ASK_AFTER_S
        found = self._client.points(self._robot, self._points_etag)
        if found is not None:
            self._points, _ = read_points(found[0], "the joint map")
            self._points_etag = found[1]
            self._points_due_s += POLL_S * (self._client.received_bytes - before) / self._limit_bytes

    def _run(self) -> None:
        wait_s = 0.0
        while not self._stop.wait(wait_s):
            try:
                self.step()
                self.trouble, self._failures, wait_s = None, 0, POLL_S
            except FcslamError as error:  # the cloud is away, or older than this program
                self.trouble, self._failures = str(error), self._failures + 1
                if not isinstance(error, UnavailableError):  # after that one, the client asks the next address itself
                    self._client.try_next()
                wait_s = getattr(error, "retry_after_s", 0.0) + POLL_S + retry_delay_s(self._failures, self._rng)

    def _in_map(self) -> frozenset[str] | None:
        index = self.map_index
        return None if index is None else frozenset(one.robot for one in self.robots() if one.map_index == index)

    def _tell(self, before: frozenset[str] | None, now: frozenset[str] | None) -> None:
        if before == now:
            return
        known, itself = {one.robot for one in self.robots()}, {self._robot}
        earlier, others = ((robots or frozenset()) - itself for robots in (before, now))
        if now is None:
            line = "this robot is in no joint map any more"
        else:
            parts = []
            if others - earlier:
                parts.append(f"joined: {', '.join(sorted(others - earlier))}")
            if split := (earlier - others) & known:
                parts.append(f"split off: {', '.join(sorted(split))}")
            if gone := earlier - others - known:
                parts.append(f"taken out: {', '.join(sorted(gone))}")
            everybody = ", ".join(sorted(others | {self._robot}))
            line = f"map {self.map_index} holds {everybody}" + "".join(f"; {part}" for part in parts)
        self.news.append(line)
