"""Replies of the cloud to a robot: acknowledgements, a correction if it is new, and newer detectors.

The same replies leave the service (``service.intake``) and the cloud within one process (``cloud.cloud``).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from fcslam.geometry.groups import group_of
from fcslam.records import Channel, Correction, DetectorFile
from fcslam.wire.messages import Acknowledgement, Body, DetectorUpdate, Packet

NEWS_M, NEWS_RAD, NEWS_QUALITY = 1e-3, 1e-5, 0.02
"""A correction that differs less from the last one is not sent. At 100 m from the origin of ``odom`` the first two
thresholds are 1 mm. Without a closure the correction changes by rounding alone, and every reply would carry it."""


@dataclass(frozen=True, slots=True)
class SessionCorrection:
    """The correction of one session."""

    robot: str
    epoch: int
    time: float
    """The largest stamp that the robot had seen when it sent what the correction rests on."""
    correction: Correction


def replies(
    robot: str,
    next_sequences: Mapping[int, int],
    newest: SessionCorrection | None,
    known_correction: int,
    announced: Mapping[Channel, DetectorFile] = MappingProxyType({}),
    versions: Mapping[Channel, str] = MappingProxyType({}),
) -> list[Packet]:
    """The packets that go back to a robot, numbered from 0.

    Args:
        robot: its name.
        next_sequences: by epoch, ascending: number of the first packet that did not arrive; the last epoch is the
            current one.
        newest: the newest correction of the current epoch.
        known_correction: version of the newest correction that the robot has; -1: none.
        announced: the detectors that robots are to use.
        versions: the robot's detectors, by its last hello.
    """
    if not next_sequences:
        return []
    expected = next_sequences.items()
    bodies: list[tuple[int, float, Body]] = [(k, 0.0, Acknowledgement(robot, k, n - 1)) for k, n in expected if n > 0]
    if newest is not None and newest.correction.version > known_correction:
        bodies.append((newest.epoch, newest.time, newest.correction))
    for channel, file in announced.items():
        if versions.get(channel, file.version) != file.version:  # a robot without the channel needs no detector
            bodies.append((max(next_sequences), 0.0, DetectorUpdate(robot, file)))
    return [Packet(robot, epoch, number, time_s, body) for number, (epoch, time_s, body) in enumerate(bodies)]


def is_news(old: Correction | None, new: Correction) -> bool:
    """Whether a robot that has ``old`` is to get ``new``; whether the correction is supported is always news."""
    if old is None or old.map_index != new.map_index:
        return True
    group = group_of(new.T_map_odom)
    moved = np.abs(old.T_map_odom[: group.axes] - new.T_map_odom[: group.axes]).max()
    turned = group.turn_rad(group.between(old.T_map_odom, new.T_map_odom))
    changed = abs(old.quality - new.quality) >= NEWS_QUALITY or (old.quality == 0.0) != (new.quality == 0.0)
    return bool(moved >= NEWS_M or turned >= NEWS_RAD or changed)
