"""Submaps of places, built from keyscans on demand and cached."""

from dataclasses import dataclass
from typing import Final

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.space import Space
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import Submap, build_submap, read_submap, self_violation, submap_bytes
from fcslam.records import Channel, FloatArray, KeyscanId, Place

UNPACKED: Final = 250
"""Submaps that are kept ready to compare, 0.2 MB each. To unpack one takes a tenth of the time to build it."""


@dataclass(slots=True)
class _Entry:
    packed: bytes | None = None
    noise: float | None = None


_Key = tuple[KeyscanId, Channel]


class SubmapCache:
    """Holds up to ``capacity`` submaps, packed; the least recently used one is dropped first."""

    def __init__(self, graph: JointGraph, space: Space, capacity: int) -> None:
        self._graph = graph
        self._space = space
        self._capacity = capacity
        self._entries: dict[_Key, _Entry] = {}
        """The one used last is the last."""
        self._unpacked: dict[_Key, Submap] = {}
        """The submaps of entries that were used last; the one used last is the last."""

    def of(self, place: Place) -> Submap:
        """The submap around a place, in its keyscan's frame, by the robot's own motions."""
        key = (place.id, place.channel)
        entry, submap = self._entry(key), self._unpacked.pop(key, None)
        if submap is None:
            submap = read_submap(entry.packed) if entry.packed is not None else build_submap(self._scans(place))
            if len(self._unpacked) >= UNPACKED:
                self._pack(next(iter(self._unpacked)))
        self._unpacked[key] = submap
        return submap

    def noise_of(self, place: Place) -> float:
        """How much the submap around a place contradicts itself (``self_violation``)."""
        entry = self._entry((place.id, place.channel))
        if entry.noise is None:
            entry.noise = self_violation(self._scans(place))
        return entry.noise

    def drop(self, place: Place) -> None:
        """Drop the submap around a place from the cache."""
        self._drop((place.id, place.channel))

    def _entry(self, key: _Key) -> _Entry:
        entry = self._entries.pop(key, None)
        if entry is None:
            entry = _Entry()
            if len(self._entries) >= self._capacity:
                self._drop(next(iter(self._entries)))
        self._entries[key] = entry
        return entry

    def _pack(self, key: _Key) -> None:
        entry, submap = self._entries[key], self._unpacked.pop(key)
        entry.packed = entry.packed or submap_bytes(submap)

    def _drop(self, key: _Key) -> None:
        self._entries.pop(key, None)
        self._unpacked.pop(key, None)

    def _scans(self, place: Place) -> list[tuple[PointScan, FloatArray]]:
        poses = self._graph.chain(place.id.robot, place.first, place.last)
        return self._space.scans(place.id, place.first, poses)
