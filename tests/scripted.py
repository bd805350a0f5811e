"""Robots whose packets and place matches are written by hand: what the cloud makes of evidence, without any LiDAR."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.submap import Agreement
from fcslam.lidar.verification import Verification
from fcslam.places.matcher import PlaceMatch
from fcslam.records import (
    Channel,
    Constraint,
    ConstraintKind,
    Keyscan,
    KeyscanId,
    LaserModel,
    Place,
    Reason,
    ReasonCode,
    frozen,
)
from fcslam.wire.messages import Body, Hello, Packet
from fcslam.wire.quantisation import dequantise

LASER = LaserModel(8, -np.pi, np.pi / 4, 10.0)
CLOSURE_INFORMATION = np.diag((1000.0, 1000.0, 10000.0))
MOTION_INFORMATION = np.diag((1e4, 1e4, 1e5))
PLACE_EVERY = 4
ALIAS = np.array([7.0, -3.0, 0.4])
"""Where a building that repeats itself would show robot b: all aliases made with it agree with one another."""


@dataclass(frozen=True)
class Script:
    """The match of the place matcher for a new place j: i, T_i_j, and whether it is fixed in every direction."""

    i: KeyscanId
    j: KeyscanId
    T_i_j: np.ndarray
    informative: bool = True
    similarity: float | None = None
    """Set: words alone say that it is the same place."""
    passes: bool = True
    """Whether the verification passes."""
    predictable: bool = True
    """Whether the two places are compared although they share a map."""


class ScriptedMatcher:
    """Stands in for PlaceMatcher: finds what the script says."""

    script: ClassVar[list[Script]] = []
    predictions: ClassVar[dict[KeyscanId, dict]] = {}
    """Places with which each place was to be compared since its robot shared a map with theirs."""

    word_count = 0

    def __init__(self, *_):
        pass

    def __len__(self):
        return 0

    def __iter__(self):
        return iter(())

    def state(self):
        return {}

    def restore(self, *_):
        pass

    def match(self, place, predicted, is_unaligned) -> list[PlaceMatch]:
        self.predictions[place.id] = dict(predicted)
        found = [line for line in self.script if line.j == place.id and (line.predictable or is_unaligned(line.i))]
        return [matched(line, predicted=not is_unaligned(line.i)) for line in found]

    def match_again(self, place, others) -> list[PlaceMatch]:
        return [matched(line, predicted=False) for line in self.script if line.j == place and line.i in others]


def matched(line: Script, predicted: bool) -> PlaceMatch:
    if line.similarity is not None:
        return PlaceMatch.similar(line.i, line.j, Channel.LIDAR, line.similarity, delta=0.85)
    return PlaceMatch.verified(line.i, line.j, Channel.LIDAR, 0.5, verified(line), predicted)


def verified(line: Script) -> Verification:
    worse = Agreement(0.9, 0.0, 600, 0.9, np.eye(2) * 100.0)
    passed = Reason(ReasonCode.VERIFIED)
    return Verification(
        frozen(line.T_i_j), CLOSURE_INFORMATION, worse, *(line.passes,) * 3, line.informative, passed, passed
    )


def rectangle(count: int = 61, step_m: float = 1.0) -> np.ndarray:
    """True poses (N, 3) on a way round a block of 20 m by 10 m, metre by metre."""
    along = np.arange(count) * step_m % 60.0
    corners = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 10.0), (0.0, 10.0), (0.0, 0.0)])
    lengths = np.array([0.0, 20.0, 30.0, 50.0, 60.0])
    heading = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])[np.searchsorted(lengths, along, side="right") - 1]
    return np.column_stack(
        (np.interp(along, lengths, corners[:, 0]), np.interp(along, lengths, corners[:, 1]), heading)
    )


def stream(robot: str, truth: np.ndarray, start_s: float, local: Iterable[Body] = ()) -> list[Packet]:
    """All packets of a robot that drives the true poses without drift: a place each ``PLACE_EVERY`` keyscans."""
    bodies: list[tuple[float, Body]] = [(start_s, Hello(robot, 0, (LASER,), {Channel.LIDAR: "test-1"}))]
    for k in range(len(truth)):
        bodies.append((start_s + k, keyscan(robot, k, start_s + k)))
        if k:
            bodies.append((start_s + k, motion(robot, k - 1, k, se2.between(truth[k - 1], truth[k]))))
        if k % PLACE_EVERY == 0:
            bodies.append((start_s + k, place(robot, k)))
    bodies += [(start_s + len(truth), body) for body in local]
    return [Packet(robot, 0, number, time, body) for number, (time, body) in enumerate(bodies)]


def keyscan(robot: str, number: int, stamp: float, beams: int = LASER.beam_count) -> Keyscan:
    return Keyscan(KeyscanId(robot, number), stamp, dequantise(np.full(beams, 1000 + number, np.uint16)))


def motion(robot: str, i: int, j: int, T_i_j: np.ndarray, kind=ConstraintKind.ODOMETRY) -> Constraint:
    return Constraint(robot, i, j, kind, frozen(T_i_j), frozen(MOTION_INFORMATION))


def place(robot: str, number: int, **changed) -> Place:
    fields = {
        "channel": Channel.LIDAR,
        "detector_version": "test-1",
        "first": number,
        "last": number,
        "keypoints": frozen(np.zeros((0, 2)), np.float32),
        "descriptors": frozen(np.zeros((0, 32)), np.uint8),
    }
    return Place(KeyscanId(robot, number), **{**fields, **changed})


def closures(
    a: tuple[str, np.ndarray], b: tuple[str, np.ndarray], pairs: Sequence[tuple[int, int]], shift=None, informative=True
) -> list[Script]:
    """The measurement between keyscans i of a and j of b; ``shift`` moves b as a whole, as an alias does."""
    (name_a, poses_a), (name_b, poses_b) = a, b
    moved = poses_b if shift is None else se2.compose(shift, poses_b)
    return [
        Script(KeyscanId(name_a, i), KeyscanId(name_b, j), se2.between(poses_a[i], moved[j]), informative)
        for i, j in pairs
    ]
