"""Submaps of places, built from keyscans on demand and cached."""

from typing import Final

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.space import Space
from fcslam.lidar.submap import Located, Submap, build_submap, read_submap, self_violation, submap_bytes
from fcslam.records import Channel, KeyscanId, Place

UNPACKED: Final = 250
"""Submaps that are kept ready to compare, 0.2 MB each. To unpack one takes a tenth of the time to build it."""
_Key = tuple[KeyscanId, Channel]


class SubmapCache:
    """Holds the submaps used last, and up to ``capacity`` packed ones, of which the oldest is dropped first."""

    def __init__(self, graph: JointGraph, space: Space, capacity: int) -> None:
        self._graph = graph
        self._space = space
        self._capacity = capacity
        self._unpacked: dict[_Key, Submap] = {}
        """The one used last is the last."""
        self._packed: dict[_Key, bytes] = {}
        self._noise: dict[_Key, float] = {}

    def of(self, place: Place) -> Submap:
        """The submap around a place, in its keyscan's frame, by the robot's own motions."""
        key = place.id, place.channel
        submap = self._unpacked.pop(key, None)
        if submap is None:
            packed = self._packed.get(key)
            submap = build_submap(self._scans(place)) if packed is None else read_submap(packed)
            if len(self._unpacked) >= UNPACKED:
                self._pack(next(iter(self._unpacked)))
        self._unpacked[key] = submap
        return submap

    def noise_of(self, place: Place) -> float:
        """How much the submap around a place contradicts itself (``self_violation``)."""
        key = place.id, place.channel
        if key not in self._noise:
            self._noise[key] = self_violation(self._scans(place))
        return self._noise[key]

    def drop(self, place: Place) -> None:
        """Drop the submap around a place from the cache."""
        for kept in (self._unpacked, self._packed, self._noise):
            kept.pop((place.id, place.channel), None)

    def _pack(self, key: _Key) -> None:
        submap = self._unpacked.pop(key)
        if key not in self._packed:
            self._packed[key] = submap_bytes(submap)
            if len(self._packed) > self._capacity:
                del self._packed[next(iter(self._packed))]

    def _scans(self, place: Place) -> list[Located]:
        poses = self._graph.chain(place.id.robot, place.first, place.last)
        return self._space.scans(place.id, place.first, poses)
