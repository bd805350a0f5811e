"""Frozen records that packages exchange. Their arrays are read-only.

Poses are (x, y, theta) in metres and radians, or (x, y, z, qx, qy, qz, qw) in space; ``T_a_b`` takes coordinates in b
to a. Coordinate frames as in ROS REP 105: ``map``, ``odom``, ``base``, ``laser``. Stamps are seconds of the recording's
own clock.
"""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.errors import InputError

StrPath = str | os.PathLike[str]

FloatArray = NDArray[np.float64]
Ranges = NDArray[np.float32]
Codes = NDArray[np.uint8]

Scalar = TypeVar("Scalar", bound=np.generic)

CODE_BYTES = 32
"""A binary descriptor is 256 bits, packed."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,63}", re.ASCII)
"""Names of robots and detector versions; they are also safe file names."""

FLOOR = re.compile(r"[A-Za-z0-9._+-]{1,16}", re.ASCII)
"""Floors of a building, as "-1" or "west.3"."""

SAME_STAMP_S = 1e-6
"""Largest difference of equal stamps: files print stamps with microseconds."""


def frozen(array: ArrayLike, dtype: type[Scalar] = np.float64) -> NDArray[Scalar]:  # type: ignore[assignment]
    """Return a read-only array of ``dtype`` with the same shape; copies only a writeable array."""
    result: NDArray[Scalar] = np.asarray(array, dtype=dtype)
    if result.flags.writeable:
        if result is array or result.base is not None:  # others may write to it
            result = result.copy()
        result.setflags(write=False)
    return result


def checked_pose(name: str, given: ArrayLike) -> FloatArray:
    """A finite pose of a user, shape (3,); ``name`` is what messages call it."""
    try:
        pose: FloatArray = frozen(given)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not a pose ({error}); give (x, y, theta)") from error
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise InputError(f"{name}: {given!r} is not a pose; give (x, y, theta) in metres and radians")
    return pose


class Beams(NamedTuple):
    """Directions of the beams of one scan in ``laser``."""

    beam_count: int
    angle_min_rad: float
    """Direction of the first beam."""
    angle_increment_rad: float
    """From one beam to the next; negative: clockwise."""

    @property
    def span_rad(self) -> float:
        """From the first to the last beam."""
        return (self.beam_count - 1) * self.angle_increment_rad


@dataclass(frozen=True, slots=True)
class LaserModel:
    """Geometry of one 2D LiDAR. Only its beams may vary from scan to scan (``geometry.beams.misfit``)."""

    beam_count: int
    angle_min_rad: float
    angle_increment_rad: float
    max_range_m: float
    """A range at or above it is invalid."""
    T_base_laser: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Mounting pose, metres and radians."""

    def angles_rad(self) -> FloatArray:
        """Directions of the beams in ``laser``, shape (beam_count,), radians."""
        return self.angle_min_rad + self.angle_increment_rad * np.arange(self.beam_count, dtype=np.float64)

    @property
    def beams(self) -> Beams:
        """The directions of the beams."""
        return Beams(self.beam_count, self.angle_min_rad, self.angle_increment_rad)

    def with_beams(self, beams: Beams) -> "LaserModel":
        """The same laser with other beams, for example of another scan."""
        return self if beams == self.beams else LaserModel(*beams, self.max_range_m, self.T_base_laser)


@dataclass(frozen=True, slots=True)
class Odometry:
    """One reading of the wheel odometry."""

    stamp: float
    T_odom_base: FloatArray
    """Shape (3,)."""


class Sweep(NamedTuple):
    """When the beams of a scan were measured, and how the robot moved meanwhile.

    The time from one beam to the next is constant. At ``t`` seconds after the stamp, the pose of ``base`` in ``base``
    at the stamp is ``velocity * t + acceleration * t**2 / 2``, for x, y and theta each.
    """

    first_s: float
    """Time of the first beam after the stamp."""
    last_s: float
    """Time of the last beam after the stamp; before ``first_s`` if the scanner turns against the order of its beams."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x and y in m/s, heading in rad/s."""
    acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x and y in m/s^2, heading in rad/s^2."""

    @property
    def duration_s(self) -> float:
        """Time between the first and the last beam."""
        return abs(self.last_s - self.first_s)

    @property
    def mean_velocity(self) -> tuple[float, float, float]:
        """Over a sweep's duration from the stamp on; x and y in m/s, heading in rad/s."""
        half_s, (vx, vy, vtheta), (ax, ay, atheta) = 0.5 * self.duration_s, self.velocity, self.acceleration
        return vx + half_s * ax, vy + half_s * ay, vtheta + half_s * atheta

    def displacement(self, t_s: float | FloatArray) -> FloatArray:
        """Pose of ``base`` at ``t_s`` after the stamp in ``base`` at the stamp, shape (3,), metres and radians.

        ``t_s`` of shape (N, 1) gives N poses, shape (N, 3).
        """
        return t_s * (np.array(self.velocity) + 0.5 * t_s * np.array(self.acceleration))

    def steps(self) -> tuple[int, ...]:
        """The eight numbers in the steps in which packets carry them (``SWEEP_STEPS``)."""
        numbers = self.first_s, self.last_s, *self.velocity, *self.acceleration
        return tuple(round(number / step) for number, step in zip(numbers, SWEEP_STEPS, strict=True))

    @classmethod
    def of_steps(cls, steps: Sequence[int]) -> Self:
        """The sweep with these eight numbers of steps."""
        first_s, last_s, *motion = (count * step for count, step in zip(steps, SWEEP_STEPS, strict=True))
        vx, vy, vtheta, ax, ay, atheta = motion
        return cls(first_s, last_s, (vx, vy, vtheta), (ax, ay, atheta))

    def rounded(self) -> Self:
        """The sweep as a packet carries it."""
        return self.of_steps(self.steps())


SWEEP_STEPS = (*2 * (1e-6,), *3 * (1e-3,), *3 * (1e-2,))
"""Steps of the numbers of a sweep: times in seconds, velocities in m/s and rad/s, accelerations in m/s^2 and rad/s^2.
In a sweep of 0.2 s, rounding moves a point by at most 0.2 mm and 0.2 mrad."""


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One revolution of a 2D LiDAR with the odometry at its stamp."""

    stamp: float
    ranges_m: Ranges
    """Shape (beam_count,). NaN, or at or above ``laser.max_range_m``: invalid; inf: no return."""
    laser: LaserModel
    """Its laser, with the beams of this scan."""
    T_odom_base: FloatArray
    """Shape (3,); NaN: unknown."""
    sweep: Sweep | None = None
    """None: all beams were measured at the stamp. The motion is that of the odometry; zeros without odometry."""
    on_teammates: NDArray[np.bool_] | None = None
    """Beams that hit another robot, shape (beam_count,): they stay, but no scan is matched by them. None: not known."""
    new_floor: str = ""
    """Floor that the robot is on from this scan on, which a new session maps; empty: none is named."""
    gyro: FloatArray | None = None
    """Readings of a gyro since the previous scan, shape (K, 2): stamp, and angular velocity about the vertical. None:
    there is no gyro, or wheels measure the motion."""

    @property
    def matched_ranges_m(self) -> Ranges:
        """The ranges by which scans are matched, shape (beam_count,): those on other robots are 0."""
        return without(self.ranges_m, self.on_teammates)


def without(ranges_m: Ranges, beams: NDArray[np.bool_] | None) -> Ranges:
    """The ranges, shape (beam_count,), with 0, invalid, for ``beams``, shape (beam_count,); None: for no beam."""
    return ranges_m if beams is None else np.where(beams, np.float32(0.0), ranges_m)


class Transform(NamedTuple):
    """A rigid transform ``T_a_b`` in three dimensions."""

    translation_m: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    """Unit quaternion (x, y, z, w)."""

    def rotation_matrix(self) -> FloatArray:
        """The rotation, shape (3, 3)."""
        x, y, z, w = self.rotation
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Pinhole model of one camera, constant over a recording; its images are undistorted."""

    width: int
    height: int
    fx: float
    """Pixels, as fy, cx and cy; (0, 0) is the centre of the first pixel."""
    fy: float
    cx: float
    cy: float
    T_base_camera: Transform
    """Mounting of the optical frame (ROS REP 103): z ahead, x to the right, y down."""


@dataclass(frozen=True, slots=True)
class CameraImage:
    """One image of a camera, kept encoded."""

    stamp: float
    encoded: bytes
    """A JPEG or PNG file of camera.width x camera.height pixels."""
    camera: CameraModel
    T_odom_base: FloatArray | None
    """Odometry at the stamp, shape (3,); None if unknown."""


@dataclass(frozen=True, slots=True)
class GnssFix:
    """A position by satellites."""

    stamp: float
    latitude_deg: float
    """On the ellipsoid WGS 84."""
    longitude_deg: float
    altitude_m: float
    """Above the ellipsoid; 0 if unknown."""
    sigma_m: float
    """Standard deviation, east and north each."""
    antenna_xy: tuple[float, float] = (0.0, 0.0)
    """Position of the antenna in ``base``, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudScan:
    """One turn of a 3D LiDAR, with the motion that other sensors measured since the turn before."""

    stamp: float
    points_m: NDArray[np.float32]
    """Returns, shape (N, 3), each in ``base`` at its own time."""
    times_s: NDArray[np.float32]
    """Time of each return after the stamp, shape (N,); zeros: all were measured at the stamp."""
    origin_m: FloatArray
    """Position of the sensor in ``base``, shape (3,)."""
    wheels: FloatArray
    """Readings of the odometry since the turn before, shape (K, 4): stamp, x, y and heading; none without odometry."""
    imu: FloatArray
    """Readings of an IMU since the turn before, shape (M, 7): stamp, angular velocity, and specific force, in the axes
    of ``base``; none without an IMU."""
    new_floor: str = ""
    """As in ``LaserScan``."""

    @property
    def T_odom_base(self) -> FloatArray:
        """Pose by odometry at the stamp, shape (3,), between the readings around it; NaN without readings."""
        if not len(self.wheels):
            return frozen(np.full(3, np.nan))
        stamps, x, y, heading = self.wheels.T
        return frozen([np.interp(self.stamp, stamps, each) for each in (x, y, np.unwrap(heading))])


SensorRecord = LaserScan | Odometry | CameraImage | GnssFix | CloudScan
"""A record of one of a robot's sensors."""


class KeyscanId(NamedTuple):
    """Identifier of a keyscan in the fleet."""

    robot: str
    number: int
    """Counts the robot's keyscans from 0."""


@dataclass(frozen=True, slots=True)
class Keyscan:
    """A scan that carries the pose graph and the map."""

    id: KeyscanId
    stamp: float
    ranges_m: Ranges
    """Shape (beam_count,), as in LaserScan: infinity for a missing return, 0 for an invalid range."""
    laser: int = 0
    """Index of its laser among those that the robot announced."""
    beams: Beams | None = None
    """Its beams; None: those that the laser was announced with."""
    sweep: Sweep | None = None
    """Times of the beams and the robot's motion, as the scan was matched; None: all were measured at the stamp."""

    def laser_model(self, lasers: Sequence[LaserModel]) -> LaserModel:
        """Its laser, with the beams of this scan; ``lasers`` are those that the robot announced."""
        laser = lasers[self.laser]
        return laser if self.beams is None else laser.with_beams(self.beams)


class ConstraintKind(StrEnum):
    """Origin of a constraint between two keyscans of one robot."""

    ODOMETRY = "odometry"
    CLOSURE = "closure"


@dataclass(frozen=True, slots=True)
class Constraint:
    """A measured relative pose of two keyscans of one robot."""

    robot: str
    i: int
    j: int
    kind: ConstraintKind
    T_i_j: FloatArray
    """Pose of keyscan j's base in keyscan i's base: in the plane, shape (3,), or in space, shape (7,)."""
    information: FloatArray
    """Inverse covariance of T_i_j in the tangent space at T_i_j (coordinates of base j), shape (3, 3) or (6, 6)."""


class Channel(StrEnum):
    """What a closure rests on; places of different channels are never compared."""

    LIDAR = "lidar"
    CAMERA = "camera"
    TAG = "tag"
    """Both keyscans saw the same tag; no place has this channel."""


PLACE_CHANNELS = (Channel.LIDAR, Channel.CAMERA)
"""Sensors of the descriptors of places."""


TagFamily = StrEnum(
    "TagFamily",
    "APRILTAG_16H5 APRILTAG_25H9 APRILTAG_36H10 APRILTAG_36H11 ARUCO_ORIGINAL 4X4_50 4X4_100 4X4_250 4X4_1000 5X5_50 "
    "5X5_100 5X5_250 5X5_1000 6X6_50 6X6_100 6X6_250 6X6_1000 7X7_50 7X7_100 7X7_250 7X7_1000",
)
"""Families of square tags, by the names of OpenCV's dictionaries without ``DICT_``."""


class Tag(NamedTuple):
    """A tag; the same one for all robots of a mission, on all days."""

    family: TagFamily
    number: int
    """Its number (id) in the family."""

    def __str__(self) -> str:
        return f"{self.family} {self.number}"


@dataclass(frozen=True, slots=True, eq=False)
class TagSighting:
    """A tag as a camera saw it near a keyscan."""

    id: KeyscanId
    tag: Tag
    T_base_tag: FloatArray
    """Pose of the tag in the keyscan's base, shape (3,), metres and radians. The heading of a tag on a wall is the
    direction that it faces; that of a tag on a floor or a ceiling is the direction of its x axis."""
    information: FloatArray
    """Inverse covariance of T_base_tag in the tangent space at T_base_tag, shape (3, 3)."""


@dataclass(frozen=True, slots=True)
class KeyscanFix:
    """A position by satellites near a keyscan; numbers as in ``GnssFix``, the antenna in the keyscan's base."""

    id: KeyscanId
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    sigma_m: float
    antenna_xy: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Place:
    """One channel of one keyscan: keypoints with binary descriptors."""

    id: KeyscanId
    channel: Channel
    detector_version: str
    first: int
    """Number of the first keyscan of its submap."""
    last: int
    """Number of the last keyscan of its submap (inclusive)."""
    keypoints: NDArray[np.float32]
    """Metres in the keyscan's base: x and y, shape (N, 2), for lidar; x, y and height z, shape (N, 3), for camera."""
    descriptors: Codes
    """Shape (N, 32)."""


MOST_NETWORK_BYTES = 64 * 1024 * 1024
"""Largest file of a detector; present ones have 0.5 to 5 MB."""


@dataclass(frozen=True, slots=True)
class DetectorFile:
    """Description of a network file that robots can download."""

    channel: Channel
    version: str
    """Detector version, which all its descriptors carry."""
    format: int
    """Format of the network (``fcslam_format`` in its metadata)."""
    size: int
    """Size of the file in bytes."""
    sha256: bytes
    """SHA-256 of the file, 32 bytes."""


Steps = NDArray[np.int16]
"""Coordinates (N, 3) in steps of ``STEP_M``."""
STEP_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class VoxelMap:
    """The surfaces around a keyscan in space, in the frame ``ground``.

    ``ground`` is level; its origin is on the floor below the keyscan's base. Its x axis has the heading of the base.
    """

    id: KeyscanId
    first: int
    """Number of the first keyscan of its scans."""
    last: int
    """Number of the last one (inclusive)."""
    T_base_ground: FloatArray
    """Shape (7,)."""
    points: Steps
    """In ``ground``, shape (N, 3): one point in each voxel with returns, by ``geometry.voxels.voxelised``."""
    origins: Steps
    """Where the scanner was, in ``ground``, shape (M, 3)."""
    seen_from: NDArray[np.uint8]
    """From which of the origins each point was seen, shape (N,)."""

    @property
    def points_m(self) -> FloatArray:
        """The points in metres, shape (N, 3)."""
        return STEP_M * self.points.astype(np.float64)

    @property
    def origins_m(self) -> FloatArray:
        """The positions of the scanner in metres, shape (M, 3)."""
        return STEP_M * self.origins.astype(np.float64)


class ClosureStatus(StrEnum):
    """Status of a closure: three stages, and two ways to be discarded."""

    CANDIDATE = "candidate"
    VERIFIED = "verified"
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    REVOKED = "revoked"


class ReasonCode(StrEnum):
    """Why a closure has its status."""

    text: str
    """The explanation, with the measured value and its limit."""

    def __new__(cls, code: str, text: str = "") -> Self:
        """A code with its explanation."""
        member = str.__new__(cls, code)
        member._value_, member.text = code, text
        return member

    FOUND_BY_ROBOT = "found_by_robot", "found by the robot"
    VERIFIED = "verified", "passes the geometric verification"
    FITS_JOINT_MAP = "fits_joint_map", "fits the joint map: {value} m off, less than {limit} m"
    IN_CLUSTER = "in_dominant_cluster", "in the dominant cluster of {value} closures"
    FITS_JOINT_GRAPH = "fits_joint_graph", "fits the joint graph"
    SAME_TAG = "same_tag", "both saw the same tag, number {value}"
    SIMILAR = "similar", "the similarity of the words is {value}, {limit} needed"
    MATCHED_POINT = "matched_point", "one of {value} matched points of the rigid fusion"
    NOT_ENOUGH_EXPLAINED = "not_enough_explained", "a share of {value} of the points lies on a surface, {limit} needed"
    IN_FREE_SPACE = "in_free_space", "a share of {value} of the points lies in free space, {limit} allowed"
    FEW_POINTS = "few_points", "{value} points lie on a surface, {limit} needed"
    LITTLE_OVERLAP = "little_overlap", "a share of {value} of the points lies in known area, {limit} needed"
    ASYMMETRIC = "asymmetric_alignment", "the alignments of both directions differ by {value}, less than {limit} needed"
    ONE_DIRECTION = "fixed_in_one_direction", "fixed in one direction only: eigenvalue {value}, {limit} needed"
    NOT_INFORMATIVE = "no_informative_closure", "none of the {value} closures fixes the position in every direction"
    FEW_CLOSURES = "few_consistent_closures", "{value} of them agree, {limit} needed"
    FEW_PLACES = "few_separate_places", "they agree from {value} separate places, {limit} needed"
    NOT_UNIQUE = "alignment_not_unique", "not unique: the score is {value} times the best elsewhere, {limit} needed"
    MAPS_CONTRADICT = "maps_contradict", "a share of {value} of the surfaces lies in free space, {limit} allowed"
    WALLS_DIFFER = "walls_differ", "walls lie farther apart than those of one place: likeness {value}, {limit} needed"
    LOOK_ALIKE = "fits_elsewhere", "the maps fit only {value} times as well as elsewhere, {limit} times needed"
    NO_LEAD = "no_clear_lead", "{value} times as many closures agree as contradict them, {limit} times needed"
    RIVAL_PLACES = "rival_has_more_places", "{value} separate places agree, but {limit} contradict them"
    CONTRADICTS_JOINT_GRAPH = "contradicts_joint_graph", "contradicts the joint graph"
    FALSE_BRIDGE = "joins_contradicting_maps", "one robot alone joins maps of which {value} pairs contradict each other"
    VETOED = "vetoed", "vetoed by hand"
    PINNED = "pinned", "pinned by hand"
    MADE_BY_HAND = "made_by_hand", "made by hand"
    UNUSED = "not_needed_by_rigid_fusion", "not needed by the rigid fusion"


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a closure has its status: a code, and the measured value, its limit and the setting behind the limit."""

    code: ReasonCode
    value: float | None = None
    limit: float | None = None
    setting: str = ""
    """Dotted name of the setting that holds the limit, as in a configuration file; empty without one."""

    def under(self, section: str) -> "Reason":
        """The same reason; ``section`` of the configuration contains the setting."""
        return replace(self, setting=f"{section}.{self.setting}") if self.setting else self

    def __str__(self) -> str:
        text = self.code.text.format(value=_short(self.value), limit=_short(self.limit))
        return f"{text} ({self.setting})" if self.setting else text


def _short(number: float | None) -> str:
    return "-" if number is None else f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"


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
    reason: Reason
    informative: bool = True
    """Whether the match constrains the pose in every direction (a bare corridor does not)."""
    tag: Tag | None = None
    """The tag that both keyscans saw, of channel ``tag``."""


@dataclass(frozen=True, slots=True)
class Veto:
    """A user's statement that places of two robots, or two places of one robot, are not the same."""

    robot_i: str
    robot_j: str
    stamps: tuple[float, float] | None = None
    """Stamps of the keyscans of i and j; None: no place of robot i is a place of robot j."""

    def forbids(self, robot_i: str, stamp_i: float, robot_j: str, stamp_j: float) -> bool:
        """Whether the veto forbids this closure, in either order of its ends."""
        ends = ((robot_i, stamp_i), (robot_j, stamp_j))
        return any(
            (self.robot_i, self.robot_j) == (i, j)
            and (self.stamps is None or math.dist(self.stamps, (at_i, at_j)) <= SAME_STAMP_S)
            for (i, at_i), (j, at_j) in (ends, ends[::-1])
        )


@dataclass(frozen=True, slots=True)
class Removal:
    """A user's statement that the packets of a robot, or of one of its sessions, have no effect."""

    robot: str
    epoch: int | None = None
    """Epoch of the session; None: all sessions of the robot, later ones as well."""


@dataclass(frozen=True, slots=True)
class Cut:
    """A user's statement that a stretch of a session does not count: not in the map, and not for closures.

    The session's motions stay, so its poses before and after the stretch are still connected.
    """

    session: str
    first_s: float
    """Stamp at which the stretch begins."""
    last_s: float


@dataclass(frozen=True, slots=True)
class Pin:
    """A user's statement that a closure that was considered is true."""

    robot_i: str
    robot_j: str
    stamps: tuple[float, float]
    """Stamps of keyscans i and j."""

    def confirms(self, robot_i: str, stamp_i: float, robot_j: str, stamp_j: float) -> bool:
        """Whether the pin is of this closure, in either order of its ends."""
        return Veto(self.robot_i, self.robot_j, self.stamps).forbids(robot_i, stamp_i, robot_j, stamp_j)


@dataclass(frozen=True, slots=True)
class ManualClosure:
    """A user's own closure between two sessions, or within one."""

    robot_i: str
    stamp_i: float
    robot_j: str
    stamp_j: float
    T_i_j: tuple[float, float, float]
    """Pose of j in i, metres and radians. Each end is the keyscan whose stamp is nearest."""
    tolerance: tuple[float, float]
    """Standard deviations, metres and radians."""


@dataclass(frozen=True, slots=True)
class Placement:
    """A user's choice of a map's coordinate frame: the pose of one of its keyscans. Of several, the last one counts."""

    session: str
    stamp: float
    pose: tuple[float, float, float]
    """T_map_base of the keyscan whose stamp is nearest, metres and radians."""


class RegionUse(StrEnum):
    """Purpose of a region."""

    ERASE = "erase"
    """Its cells are unknown."""
    FREE = "free"
    """Its cells are free."""
    KEEP_OUT = "keep-out"
    """Robots must not enter it."""
    AREA = "area"
    """A named part of the building."""


@dataclass(frozen=True, slots=True)
class MapRegion:
    """A polygon that a user drew in a map. It is tied to a keyscan, so it moves with the map."""

    use: RegionUse
    name: str
    session: str
    stamp: float
    polygon: tuple[tuple[float, float], ...]
    """Corners (x, y) in the base frame of the session's keyscan whose stamp is nearest, metres."""


@dataclass(frozen=True, slots=True)
class FloorLabel:
    """A user's statement which floor a session is on, whatever it named. Of several, the last one counts."""

    session: str
    floor: str
    """1 to 16 letters, digits and ``. _ + -``."""


@dataclass(frozen=True, slots=True)
class Undo:
    """A user's statement that an earlier edit is not in force any more."""

    number: int
    """Number of the edit."""


Change = Veto | Removal | Cut | Pin | ManualClosure | Placement | MapRegion | FloorLabel
"""The change that an edit makes to a mission."""


@dataclass(frozen=True, slots=True)
class Edit:
    """One line of the log of what users changed about a mission by hand."""

    number: int
    """Counts the edits of a mission from 1."""
    author: str
    time_s: float
    """Seconds since 1970."""
    content: Change | Undo


@dataclass(frozen=True, slots=True)
class Correction:
    """The cloud's message to a robot: the pose of its smooth, drifting frame ``odom`` in the fleet's map."""

    robot: str
    version: int
    map_index: int
    """Identifies one of the maps that are not joined yet; it may change when maps join."""
    T_map_odom: FloatArray
    """Shape (3,), or (7,) in space. Here, ``odom`` is the chain of motions between keyscans; the first is zero."""
    quality: float = 0.0
    """Support by other sessions, in [0, 1]; 0 if no other session supports the pose. It is the agreement of the newest
    comparison with places of other sessions, times 1 - 2^-n with n places that closures connect to others. Both count
    less with travel.
    """
