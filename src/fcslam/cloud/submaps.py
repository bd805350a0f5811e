"""Submaps of places, built from keyscans on demand and cached."""

from dataclasses import dataclass

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.submap import Submap, build_submap, self_violation
from fcslam.records import Channel, FloatArray, KeyscanId, Place


@dataclass(slots=True)
class _Entry:
    """What is known of the submap around a place."""

    submap: Submap
    noise: float | None = None
    """None until it is asked for."""


class SubmapCache:
    """Holds up to ``capacity`` submaps; the least recently used one is dropped first."""

    def __init__(self, sessions: SessionStore, graph: JointGraph, capacity: int) -> None:
        self._sessions = sessions
        self._graph = graph
        self._capacity = capacity
        self._entries: dict[tuple[KeyscanId, Channel], _Entry] = {}

    def of(self, place: Place) -> Submap:
        """The submap around a place, in its keyscan's frame, by the robot's own motions."""
        return self._entry(place).submap

    def noise_of(self, place: Place) -> float:
        """How much the submap around a place contradicts itself (``self_violation``)."""
        entry = self._entry(place)
        if entry.noise is None:
            entry.noise = self_violation(self._scans(place))
        return entry.noise

    def drop(self, place: Place) -> None:
        """Drop the submap around a place from the cache."""
        self._entries.pop((place.id, place.channel), None)

    def _entry(self, place: Place) -> _Entry:
        key = (place.id, place.channel)
        entry = self._entries.pop(key, None)
        if entry is None:
            entry = _Entry(build_submap(self._scans(place)))
            if len(self._entries) >= self._capacity:
                del self._entries[next(iter(self._entries))]
        self._entries[key] = entry  # newest last
        return entry

    def _scans(self, place: Place) -> list[tuple[PointScan, FloatArray]]:
        """The scans around a place, and their poses (3,) in its keyscan's base."""
        robot = place.id.robot
        lasers, anchor = self._sessions.lasers(robot), self._graph.chain(robot, place.id.number, place.id.number)[0]
        poses = se2.between(anchor, self._graph.chain(robot, place.first, place.last))
        keyscans = self._sessions.keyscans(robot, place.first, place.last)
        return [
            (point_scan(keyscan.ranges_m, keyscan.laser_model(lasers)), pose)
            for keyscan, pose in zip(keyscans, poses, strict=True)
        ]
