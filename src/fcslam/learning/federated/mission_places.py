"""The camera places of a running mission, and which of them show the same place by the accepted closures.

They come from the packets that the service stored and from the live run folder, so the mission's worker is not asked.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fcslam.cloud.sessions import robot_of, session_name
from fcslam.errors import EvaluationError
from fcslam.geometry import se2
from fcslam.learning.federated.held_out import APART_M, PlacePoints, inliers
from fcslam.learning.revisits import FARTHEST_M, WIDEST_RAD
from fcslam.mission.mission_store import MissionStore
from fcslam.records import Channel, ClosureStatus, FloatArray, Place
from fcslam.runs import RobotTrajectory, Run, open_run
from fcslam.service.mission_folder import MissionFolder
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import decode

REACH_M: Final = 3.0
"""Places this close to an end of a closure, by the robot's own way, belong to it."""
AT_ONCE: Final = 2000
MOST_APART: Final = 300
"""Pairs of different places that are compared."""


class PlaceKey(NamedTuple):
    """A keyscan that has camera places."""

    session: str
    keyscan: int


@dataclass(slots=True)
class MissionPlaces:
    """Follows one mission."""

    folder: MissionFolder
    places: dict[PlaceKey, dict[str, Place]] = field(default_factory=dict)
    """By keyscan and detector version, the newest version last."""
    run: Run | None = None
    """The live run; None before there is one."""
    _arrival: int = 0
    _live: Path | None = None

    def follow(self) -> bool:
        """Read what is new; returns whether the live run is another one than at the last call.

        Raises:
            StoreError: the mission cannot be read.
        """
        if not self.folder.live.exists():
            return False
        live = self.folder.live.resolve()
        self._read_packets()
        if live == self._live:
            return False
        try:
            self.run = open_run(live, maps=False)
        except EvaluationError:  # the worker replaced it meanwhile
            return False
        self._live = live
        return True

    def pairs(self) -> Iterable[tuple[PlaceKey, PlaceKey]]:
        """Places of two robots that accepted closures connect, each pair once."""
        return dict.fromkeys(self._near_closures())

    def described_by(self, first: str, second: str) -> dict[PlaceKey, tuple[PlacePoints, PlacePoints]]:
        """The places that two detector versions described, by both."""
        return {
            key: (points_of(versions[first]), points_of(versions[second]))
            for key, versions in self.places.items()
            if first in versions and second in versions
        }

    def found_again(self, version: str, before: str) -> FloatArray:
        """For each pair of places that both versions described: found (1) or not (0) with the version, less with the
        one before, shape (N,). A pair is found if it is more similar than any two different places."""
        described = self.described_by(version, before)
        same = [(a, b) for a, b in self.pairs() if a in described and b in described]
        apart = self._apart(described)
        if not apart:
            return np.empty(0)
        found = []
        for k in (0, 1):
            limit = max(inliers(described[a][k], described[b][k]) for a, b in apart)
            found.append([inliers(described[a][k], described[b][k]) > limit for a, b in same])
        return np.array(found[0], np.float64) - np.array(found[1], np.float64)

    def _read_packets(self) -> None:
        store = MissionStore(self.folder.store)
        try:
            while packets := store.arrivals(self._arrival, AT_ONCE):
                for arrival, packet in packets:
                    self._arrival = arrival
                    if packet.kind is PacketKind.PLACE and packet.channel is Channel.CAMERA and packet.refusal is None:
                        place = decode(packet.data).body
                        assert isinstance(place, Place)
                        key = PlaceKey(session_name(packet.robot, packet.epoch), place.id.number)
                        versions = self.places.setdefault(key, {})
                        versions.pop(place.detector_version, None)
                        versions[place.detector_version] = place
        finally:
            store.close()

    def _near_closures(self) -> Iterator[tuple[PlaceKey, PlaceKey]]:
        if self.run is None:
            return
        by_session = defaultdict(list)
        for key in self.places:
            by_session[key.session].append(key.keyscan)
        for closure in self.run.closures:
            names = closure.robot_i, closure.robot_j
            if closure.status is not ClosureStatus.ACCEPTED or robot_of(names[0]) == robot_of(names[1]):
                continue
            a, b = (self.run.trajectories.get(name) for name in names)
            if a is None or b is None or a.map_index != b.map_index:
                continue
            for i in _near(a, closure.stamp_i, by_session[names[0]]):
                for j in _near(b, closure.stamp_j, by_session[names[1]]):
                    T_i_j = se2.between(a.T_map_base[i], b.T_map_base[j])
                    if np.hypot(*T_i_j[:2]) <= FARTHEST_M and abs(T_i_j[2]) <= WIDEST_RAD:
                        yield (PlaceKey(names[0], i), PlaceKey(names[1], j))

    def _apart(self, described: Mapping[PlaceKey, object]) -> list[tuple[PlaceKey, PlaceKey]]:
        """Pairs of these places that are far from each other in one map."""
        poses = {key: pose for key in described if (pose := self._pose(key)) is not None}
        keys = sorted(poses)
        found = [
            (a, b)
            for number, a in enumerate(keys)
            for b in keys[number + 1 :]
            if poses[a][0] == poses[b][0] and np.hypot(*(poses[a][1] - poses[b][1])[:2]) > APART_M
        ]
        return [found[k] for k in np.linspace(0, len(found) - 1, min(len(found), MOST_APART)).astype(int)]

    def _pose(self, key: PlaceKey) -> tuple[int, FloatArray] | None:
        """Map and pose of a keyscan."""
        trajectory = None if self.run is None else self.run.trajectories.get(key.session)
        if trajectory is None or key.keyscan >= len(trajectory.stamps):
            return None
        return trajectory.map_index, trajectory.T_map_base[key.keyscan]


def points_of(place: Place) -> PlacePoints:
    """The keypoints of a place in the base of its keyscan."""
    return PlacePoints(place.keypoints.astype(np.float64), place.descriptors)


def _near(trajectory: RobotTrajectory, stamp: float, keyscans: list[int]) -> list[int]:
    """Those of a session's keyscans on the stretch of its way around a stamp that stays within ``REACH_M``."""
    here = int(np.argmin(np.abs(trajectory.stamps - stamp)))
    near = np.hypot(*(trajectory.T_map_base[:, :2] - trajectory.T_map_base[here, :2]).T) <= REACH_M
    low = high = here
    while low > 0 and near[low - 1]:
        low -= 1
    while high + 1 < len(near) and near[high + 1]:
        high += 1
    return [number for number in keyscans if low <= number <= high]
