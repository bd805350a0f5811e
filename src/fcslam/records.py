"""Frozen records that cross the borders between rooms. Arrays in them are read-only.

Poses are (x, y, theta) in metres and radians; ``T_a_b`` takes coordinates in b to a. Coordinate frames as in ROS
REP 105: ``map``, ``odom``, ``base``, ``laser``. Stamps are seconds of the recording's own clock.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
Ranges = NDArray[np.float32]
Codes = NDArray[np.uint8]

Scalar = TypeVar("Scalar", bound=np.generic)

CODE_BYTES = 32
"""A binary descriptor is 256 bits, packed."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,63}", re.ASCII)
"""Names of robots and detector versions: also safe as file names."""

SAME_STAMP_S = 1e-6
"""Stamps that differ by less are one: files print them with so many digits."""


def frozen(array: ArrayLike, dtype: type[Scalar] = np.float64) -> NDArray[Scalar]:  # type: ignore[assignment]
    """A read-only array of ``dtype``; copied only if it has to be."""
    result: NDArray[Scalar] = np.asarray(array, dtype=dtype)
    if result.flags.writeable:
        result = result.copy()
        result.setflags(write=False)
    return result


@dataclass(frozen=True, slots=True)
class LaserModel:
    """Geometry of one 2D LiDAR, constant over a recording."""

    beam_count: int
    angle_min_rad: float
    angle_increment_rad: float
    max_range_m: float
    """A range at or above it means that nothing was hit."""
    T_base_laser: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def angles_rad(self) -> FloatArray:
        """Beam directions in ``laser``, shape (beam_count,)."""
        return self.angle_min_rad + self.angle_increment_rad * np.arange(self.beam_count, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Odometry:
    """One reading of the wheel odometry."""

    stamp: float
    T_odom_base: FloatArray


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One revolution of a 2D LiDAR with the odometry at its stamp."""

    stamp: float
    ranges_m: Ranges
    """Shape (beam_count,). NaN: invalid; at or above ``laser.max_range_m`` (or inf): nothing was hit."""
    laser: LaserModel
    T_odom_base: FloatArray


class Transform(NamedTuple):
    """``T_a_b`` in three dimensions."""

    translation_m: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    """Quaternion (x, y, z, w) of length 1."""


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Pinhole geometry of one camera, constant over a recording; its images are free of distortion."""

    width: int
    height: int
    fx: float
    """Pixels, as fy, cx and cy; (0, 0) is the centre of the first pixel."""
    fy: float
    cx: float
    cy: float
    T_base_camera: Transform
    """Of the optical frame as in ROS REP 103: z ahead, x to the right, y down."""


@dataclass(frozen=True, slots=True)
class CameraImage:
    """One image of a camera, kept encoded."""

    stamp: float
    encoded: bytes
    """A JPEG or PNG file of camera.width x camera.height pixels."""
    camera: CameraModel
    T_odom_base: FloatArray | None
    """The odometry at the stamp; None: not known."""


SensorRecord = LaserScan | Odometry | CameraImage
"""What a robot senses."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Where the robot really was, in the frame of the building. No robot is ever told."""

    stamp: float
    T_building_base: FloatArray


RecordedItem = SensorRecord | GroundTruth
"""What a recording can hold."""


class KeyscanId(NamedTuple):
    """A keyscan of the fleet."""

    robot: str
    number: int
    """Counts the robot's keyscans from 0."""


@dataclass(frozen=True, slots=True)
class Keyscan:
    """A scan that carries the pose graph and the map."""

    id: KeyscanId
    stamp: float
    ranges_m: Ranges
    """As in LaserScan, but an invalid or missing return is 0."""


class ConstraintKind(StrEnum):
    """Where a constraint between two keyscans of one robot comes from."""

    ODOMETRY = "odometry"
    CLOSURE = "closure"


@dataclass(frozen=True, slots=True)
class Constraint:
    """A measured motion between two keyscans of one robot."""

    robot: str
    i: int
    j: int
    kind: ConstraintKind
    T_i_j: FloatArray
    """Pose of keyscan j's base in keyscan i's base, shape (3,)."""
    information: FloatArray
    """Inverse covariance of T_i_j in the tangent space at T_i_j (x, y, theta of base j), shape (3, 3)."""


class Channel(StrEnum):
    """Which sensor a place's descriptors come from; words of different channels are never compared."""

    LIDAR = "lidar"
    CAMERA = "camera"


@dataclass(frozen=True, slots=True)
class Place:
    """One channel of one keyscan: binary descriptors with where each was seen."""

    id: KeyscanId
    channel: Channel
    detector_version: str
    first: int
    """Number of the first keyscan of the submap it was seen in."""
    last: int
    """Number of the last one (inclusive)."""
    keypoints: NDArray[np.float32]
    """Metres in the keyscan's base: x and y, shape (N, 2), if lidar; with the height z, shape (N, 3), if camera."""
    descriptors: Codes
    """Shape (N, 32)."""


@dataclass(frozen=True, slots=True)
class DetectorFile:
    """A network that describes places, as a file that is not here yet."""

    channel: Channel
    version: str
    """Stamps every descriptor that it makes."""
    format: int
    """Of the network, as its own metadata say."""
    size: int
    """Bytes of the file."""
    sha256: bytes
    """Of the file, 32 bytes."""


class ClosureStatus(StrEnum):
    """How far a closure has come; three different things and two ways to end."""

    CANDIDATE = "candidate"
    VERIFIED = "verified"
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    REVOKED = "revoked"


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """The claim that two keyscans saw the same place."""

    i: KeyscanId
    j: KeyscanId
    channel: Channel
    similarity: float
    """In [0, 1]."""
    T_i_j: FloatArray
    information: FloatArray
    status: ClosureStatus
    reason: str
    informative: bool = True
    """Whether the match fixes the pose in every direction (a bare corridor does not)."""


@dataclass(frozen=True, slots=True)
class Veto:
    """Somebody knows that two robots' places (or two places of one robot) are not the same, whatever they look like."""

    robot_i: str
    robot_j: str
    stamps: tuple[float, float] | None = None
    """Of the keyscans of i and j; None: no place of the one is a place of the other."""

    def forbids(self, robot_i: str, stamp_i: float, robot_j: str, stamp_j: float) -> bool:
        """Whether it speaks of this closure, told from either end."""
        ends = ((robot_i, stamp_i), (robot_j, stamp_j))
        return any(
            (self.robot_i, self.robot_j) == (i, j) and (self.stamps is None or _same_stamps(self.stamps, (at_i, at_j)))
            for (i, at_i), (j, at_j) in (ends, ends[::-1])
        )


def _same_stamps(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return abs(a[0] - b[0]) <= SAME_STAMP_S and abs(a[1] - b[1]) <= SAME_STAMP_S


@dataclass(frozen=True, slots=True)
class Correction:
    """What the cloud tells a robot: where its smooth, drifting frame lies in the fleet's map."""

    robot: str
    version: int
    map_index: int
    """Tells apart maps that are not joined yet; it may change when maps join."""
    T_map_odom: FloatArray
    """``odom`` here is the chain of the robot's own motions between keyscans, from zero at its first."""
    quality: float = 0.0
    """How well others bear it out, in [0, 1]: of what the session saw at its newest place that others have seen as
    well, the share that lies where they saw it, times 1 - 2^-n with n closures to others. 0: none holds it in the map.
    """
