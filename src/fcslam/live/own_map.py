"""The map of a live robot, in the worker of its back end: the cloud of a mission with one robot.

So a robot alone closes loops and draws maps as ``fcslam map`` does, and no scan waits for it.
"""

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from typing import TypeVar

import numpy as np

from fcslam.cloud.host import FleetHost
from fcslam.cloud.report import Track
from fcslam.errors import FcslamError
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.mission.mission import MissionCloud, MissionConfig
from fcslam.records import Correction, FloatArray
from fcslam.robot.backend_runner import WorkerObject
from fcslam.runs import Run
from fcslam.wire.messages import Packet
from fcslam.wire.packets import measure

Answer = TypeVar("Answer")
Correct = Callable[[int, Correction], None]
"""Takes a correction and its session; called in another thread."""


class OwnMap:
    """Gets all packets of one robot, in their order, and corrects its poses. Any thread may call."""

    def __init__(self, robot: str, config: MissionConfig, executor: Executor, correct: Correct) -> None:
        self._robot, self._correct = robot, correct
        self.failure: str | None = None
        """Why the map stopped growing; None if it grows."""
        self._applying: deque[Future[list[tuple[int, Correction]]]] = deque()
        self._kept: list[Packet] = []
        """Packets that the worker does not have yet: to hand over each for itself would cost scans time."""
        self._lock = threading.Lock()
        self._cloud = WorkerObject(executor, f"map of {robot}", MissionCloud, config)

    def put(self, packets: Sequence[Packet]) -> None:
        """Keep the next packets for ``hand_over``; each answer is of all packets so far."""
        if self.failure is None:
            with self._lock:
                self._kept.extend(packets)

    def hand_over(self, before_s: float = np.inf) -> None:
        """Have the packets applied, later, if the oldest one is from before a time of its robot."""
        with self._lock:
            if self._kept and self._kept[0].time < before_s:
                packets, self._kept = self._kept, []
                applied = self._cloud.call(_apply, packets)
                self._forget_applied()
                self._applying.append(applied)
                applied.add_done_callback(self._take)

    @property
    def backlog(self) -> int:
        """Number of batches of packets that are not applied yet."""
        with self._lock:
            self._forget_applied()
            return len(self._applying)

    def draw(self, session: str, T_map_own: FloatArray) -> OccupancyMap:
        """The map that a session is in, moved by the pose of the robot's own map in ``map``, shape (3,)."""
        drawn: OccupancyMap = self._answer(_call_host, FleetHost.draw, session, T_map_own)
        return drawn

    def poses(self, session: str) -> FloatArray:
        """``T_own_base`` of the session's keyscans so far, shape (K, 3), metres and radians."""
        return self._answer(_call_host, FleetHost.poses, session)

    def points(self, session: str, T_map_own: FloatArray) -> FloatArray:
        """A point for each voxel of the map that a session is in, shape (N, 3); ``T_map_own`` as in ``draw``."""
        return self._answer(_call_host, FleetHost.points, session, T_map_own)

    def closures(self, session: str, T_map_own: FloatArray) -> FloatArray:
        """Both ends of each accepted closure in the map that a session is in, shape (N, 2, 2), metres in ``map``."""
        return self._answer(_call_host, FleetHost.closures, session, T_map_own)

    def run(self, tracks: Mapping[str, Track], scans: int) -> Run:
        """The result of all packets so far; arguments as in ``MissionCloud.run``."""
        return self._answer(MissionCloud.run, tracks, scans)

    def _forget_applied(self) -> None:
        while self._applying and self._applying[0].done():
            self._applying.popleft()

    def _take(self, done: Future[list[tuple[int, Correction]]]) -> None:
        if done.cancelled():
            return
        error = done.exception()
        if error is not None:
            self.failure = self.failure or f"{type(error).__name__}: {error}"
            return
        for session, correction in done.result():
            self._correct(session, correction)

    def _answer(self, function: Callable[..., Answer], *arguments: object) -> Answer:
        self.hand_over()
        try:
            return self._cloud.call(function, *arguments).result()
        except FcslamError:
            raise
        except Exception as error:
            raise FcslamError(f"{self._robot}: the robot's map is gone: {type(error).__name__}: {error}") from error


def _call_host(cloud: MissionCloud, function: Callable[..., Answer], *arguments: object) -> Answer:
    return function(cloud.host, *arguments)


def _apply(cloud: MissionCloud, packets: Sequence[Packet]) -> list[tuple[int, Correction]]:
    replies = [reply for packet in packets for reply in cloud.apply(measure(packet))]
    return [(reply.epoch, reply.body) for reply in replies if isinstance(reply.body, Correction)]
