"""Submaps of places, built from keyscans on demand and cached."""

from dataclasses import dataclass

import numpy as np

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan, keyscan_points
from fcslam.lidar.submap import PackedSubmap, Submap, build_submap, self_violation
from fcslam.lidar.submap_bytes import packed_bytes, read_packed
from fcslam.records import Channel, FloatArray, KeyscanId, Place
from fcslam.storage.state_file import State


@dataclass(slots=True)
class _Entry:
    """The submap around a place and values derived from it; None until they are needed."""

    submap: Submap | None = None
    noise: float | None = None


_Key = tuple[KeyscanId, Channel]


class SubmapCache:
    """Holds up to ``capacity`` submaps; the least recently used one is dropped first."""

    def __init__(self, sessions: SessionStore, graph: JointGraph, capacity: int) -> None:
        self._sessions = sessions
        self._graph = graph
        self._capacity = capacity
        self._entries: dict[_Key, _Entry] = {}
        """The one used last is the last."""

    def of(self, place: Place) -> Submap:
        """The submap around a place, in its keyscan's frame, by the robot's own motions."""
        entry = self._entry(place)
        if entry.submap is None:
            entry.submap = build_submap(self._scans(place))
        return entry.submap

    def noise_of(self, place: Place) -> float:
        """How much the submap around a place contradicts itself (``self_violation``)."""
        entry = self._entry(place)
        if entry.noise is None:
            entry.noise = self_violation(self._scans(place))
        return entry.noise

    def state(self) -> State:
        """The submaps that were compared, so that they need not be built again; for ``restore``."""
        built = {key: entry for key, entry in self._entries.items() if entry.submap is not None}
        content = [packed_bytes(PackedSubmap.of(entry.submap)) for entry in built.values() if entry.submap is not None]
        return {
            "keys": [(*identifier, channel) for identifier, channel in built],
            "noise": [entry.noise for entry in built.values()],
            "sizes": [len(data) for data in content],
            "content": np.frombuffer(b"".join(content), np.uint8),
        }

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        content, begin = state["content"].tobytes(), 0
        for (robot, number, channel), noise, size in zip(state["keys"], state["noise"], state["sizes"], strict=True):
            submap = read_packed(content[begin : begin + size]).unpack()
            self._entries[KeyscanId(robot, number), Channel(channel)] = _Entry(submap, noise)
            begin += size

    def drop(self, place: Place) -> None:
        """Drop the submap around a place from the cache."""
        self._entries.pop((place.id, place.channel), None)

    def _entry(self, place: Place) -> _Entry:
        key = (place.id, place.channel)
        entry = self._entries.pop(key, None)
        if entry is None:
            entry = _Entry()
            if len(self._entries) >= self._capacity:
                del self._entries[next(iter(self._entries))]
        self._entries[key] = entry
        return entry

    def _scans(self, place: Place) -> list[tuple[PointScan, FloatArray]]:
        """The scans around a place, and their poses (3,) in its keyscan's base."""
        robot = place.id.robot
        lasers, anchor = self._sessions.lasers(robot), self._graph.chain(robot, place.id.number, place.id.number)[0]
        poses = se2.between(anchor, self._graph.chain(robot, place.first, place.last))
        keyscans = self._sessions.keyscans(robot, place.first, place.last)
        return [(keyscan_points(keyscan, lasers), pose) for keyscan, pose in zip(keyscans, poses, strict=True)]
