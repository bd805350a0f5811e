"""Packets for the robots of a running mission: codes on which places of other robots agree."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Final

import numpy as np

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.cloud.teaching import PlacePoints, teach
from fcslam.geometry import se2
from fcslam.learning.federated.mission_places import MissionPlaces, PlaceKey, points_of
from fcslam.learning.revisits import FEWEST_SHARED
from fcslam.records import FloatArray, frozen
from fcslam.wire.batches import LENGTH, write_batch
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS
from fcslam.wire.messages import Packet, TaughtPlace
from fcslam.wire.packets import encode

MOST_OTHERS: Final = 12
"""Places of others, the nearest ones, that teach a place."""


def lessons(mission: MissionPlaces) -> dict[str, bytes]:
    """A batch of packets for each robot that others can teach something."""
    others: dict[PlaceKey, list[tuple[PlaceKey, FloatArray]]] = defaultdict(list)
    for first, second, T_first_second in mission.pairs():
        others[first].append((second, T_first_second))
        others[second].append((first, se2.inverse(T_first_second)))
    packets: dict[str, list[tuple[int, TaughtPlace]]] = defaultdict(list)
    for key, near in others.items():
        taught = _taught(mission, key, near)
        if taught is not None:
            packets[taught.robot].append((robot_and_epoch(key.session)[1], taught))
    return {robot: _batch(found) for robot, found in packets.items()}


def _taught(mission: MissionPlaces, key: PlaceKey, near: Sequence[tuple[PlaceKey, FloatArray]]) -> TaughtPlace | None:
    """The codes of others for one place, in the version that described it last; None if there are few."""
    place = next(reversed(mission.places[key].values()))
    version = place.detector_version
    nearest = sorted(near, key=lambda other: float(np.hypot(*other[1][:2])))
    known = [(mission.places[other][version], T) for other, T in nearest if version in mission.places[other]]
    codes = teach(points_of(place), [_moved(points_of(other), T) for other, T in known[:MOST_OTHERS]])
    if len(codes.rows) < FEWEST_SHARED:
        return None
    return TaughtPlace(
        robot_and_epoch(key.session)[0], key.keyscan, version, len(place.keypoints), frozen(codes.rows, np.uint16),
        frozen(codes.codes, np.uint8),
    )  # fmt: skip


def _batch(found: Sequence[tuple[int, TaughtPlace]]) -> bytes:
    """As many packets as one batch takes, those with most codes first."""
    ordered = sorted(found, key=lambda each: (-len(each[1].rows), each[0], each[1].number))
    chosen, size = [], 0
    for number, (epoch, taught) in enumerate(ordered[:MAXIMUM_BATCH_PACKETS]):
        data = encode(Packet(taught.robot, epoch, number, 0.0, taught))
        size += LENGTH.size + len(data)
        if size > MAXIMUM_BATCH_BYTES:
            break
        chosen.append(data)
    return write_batch(chosen)


def _moved(points: PlacePoints, T: FloatArray) -> PlacePoints:
    positions = points.positions.copy()
    positions[:, :2] = se2.transform(T, positions[:, :2])
    return PlacePoints(positions, points.codes)
