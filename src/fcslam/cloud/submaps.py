"""Submaps of places, built from keyscans on demand and cached."""

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.submap import Submap, build_submap, self_violation
from fcslam.records import Channel, FloatArray, KeyscanId, Place


class SubmapCache:
    """Holds up to ``capacity`` submaps; the least recently used one is dropped first."""

    def __init__(self, sessions: SessionStore, graph: JointGraph, capacity: int) -> None:
        self._sessions = sessions
        self._graph = graph
        self._capacity = capacity
        self._submaps: dict[tuple[KeyscanId, Channel], Submap] = {}
        self._noise: dict[tuple[KeyscanId, Channel], float] = {}

    def of(self, place: Place) -> Submap:
        """The submap around a place, in its keyscan's frame, by the robot's own motions."""
        key = (place.id, place.channel)
        submap = self._submaps.pop(key, None)
        if submap is None:
            submap = build_submap(self._scans(place))
            if len(self._submaps) >= self._capacity:
                del self._submaps[next(iter(self._submaps))]
        self._submaps[key] = submap  # newest last
        return submap

    def noise_of(self, place: Place) -> float:
        """How much the submap around a place contradicts itself (``self_violation``)."""
        key = (place.id, place.channel)
        if key not in self._noise:
            self._noise[key] = self_violation(self._scans(place))
        return self._noise[key]

    def drop(self, place: Place) -> None:
        """Drop the submap around a place from the cache."""
        self._submaps.pop((place.id, place.channel), None)
        self._noise.pop((place.id, place.channel), None)

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
