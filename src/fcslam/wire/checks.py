"""Validation of packets: the same checks before writing and after reading."""

import math
from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import PacketError
from fcslam.geometry.beams import FULL_TURN_RAD, LARGEST_SPAN_RAD
from fcslam.geometry.voxels import MOST_POINTS, are_inside, voxel_keys
from fcslam.records import (
    CODE_BYTES,
    FLOOR,
    MOST_NETWORK_BYTES,
    NAME,
    Beams,
    Constraint,
    Correction,
    FloatArray,
    Keyscan,
    KeyscanFix,
    LaserModel,
    Place,
    Sweep,
    TagSighting,
    VoxelMap,
    frozen,
)
from fcslam.wire import limits
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet
from fcslam.wire.quantisation import MAXIMUM_KEYPOINT_M, dequantise, pack_information, quantise, unpack_information

_NUMBER = 0, 2**31 - 1
"""Numbers of keyscans, versions and maps."""
_ABOVE_0 = math.ulp(0.0)
_EPOCH, _SEQUENCE = (0, limits.MAXIMUM_EPOCH), (0, limits.MAXIMUM_SEQUENCE)

_BOUNDS: dict[type, dict[str, tuple[float, float]]] = {
    Packet: {"epoch": _EPOCH, "sequence": _SEQUENCE, "time": (-math.inf, math.inf)},
    Beams: {
        "beam_count": (1, limits.MAXIMUM_BEAMS),
        "angle_min_rad": (-FULL_TURN_RAD, FULL_TURN_RAD),
        "angle_increment_rad": (-FULL_TURN_RAD, FULL_TURN_RAD),
    },
    LaserModel: {"max_range_m": (_ABOVE_0, limits.MAXIMUM_LASER_RANGE_M)},
    Sweep: {"first_s": (-2.0, 2.0), "last_s": (-2.0, 2.0)},
    Keyscan: {"id.number": _NUMBER, "laser": (0, limits.MAXIMUM_LASERS - 1)},
    Constraint: {"i": _NUMBER, "j": _NUMBER},
    Place: {"id.number": _NUMBER, "first": _NUMBER, "last": _NUMBER},
    TagSighting: {"id.number": _NUMBER, "tag.number": (0, 4095)},
    VoxelMap: {"id.number": _NUMBER, "first": _NUMBER, "last": _NUMBER},
    KeyscanFix: {
        "id.number": _NUMBER,
        "latitude_deg": (-90.0, 90.0),
        "longitude_deg": (-360.0, 360.0),
        "altitude_m": (-1e5, 1e5),
        "sigma_m": (_ABOVE_0, 1e4),
    },
    Correction: {"version": _NUMBER, "map_index": _NUMBER, "quality": (0.0, 1.0)},
    Acknowledgement: {"epoch": _EPOCH, "sequence": _SEQUENCE},
    DetectorUpdate: {"file.format": _NUMBER, "file.size": (1, MOST_NETWORK_BYTES)},
}
"""Lowest and highest value of each number of a record."""
_LIMITS = {
    record: tuple((path, attrgetter(path), *limits) for path, limits in bounds.items())
    for record, bounds in _BOUNDS.items()
}
_MOST_MOTION = 50.0, 500.0
"""Largest velocity and acceleration during a scan: m/s and rad/s, m/s^2 and rad/s^2."""
_ANTENNA_M = 1000.0
"""Largest distance of an antenna from the base of a keyscan."""


def check(packet: Packet) -> None:
    """Refuse a packet that violates the format."""
    body = packet.body
    check_name(packet.robot, "robot")
    _check_numbers(packet)
    _require(math.isfinite(packet.time), "time is not finite")
    robot = body.id.robot if isinstance(body, Keyscan | Place | TagSighting | KeyscanFix | VoxelMap) else body.robot
    _require(robot == packet.robot, f"a packet of robot {packet.robot} holds a record of robot {robot!r}")
    _check_numbers(body)
    match body:
        case Hello():
            _require(body.epoch == packet.epoch, f"hello: epoch {body.epoch} in a packet of epoch {packet.epoch}")
            _check_hello(body)
        case Keyscan():
            _check_keyscan(body)
            _require(body.stamp <= packet.time, "keyscan: stamp is later than the packet's time")
        case Constraint():
            _require(body.i < body.j, f"constraint: i = {body.i} is not below j = {body.j}")
            _check_motion(body.T_i_j, "constraint: T_i_j")
            _check_information(body.information, "constraint", 3 if body.T_i_j.shape == (3,) else 6)
        case Place():
            _check_place(body)
        case VoxelMap():
            _check_voxel_map(body)
        case TagSighting():
            _check_pose(body.T_base_tag, "tag sighting: T_base_tag", math.pi)
            _check_information(body.information, "tag sighting")
        case KeyscanFix():
            is_near = math.hypot(*body.antenna_xy) <= _ANTENNA_M
            _require(is_near, f"fix: the antenna is not within {_ANTENNA_M:g} m of the robot")
        case Correction():
            _check_motion(body.T_map_odom, "correction: T_map_odom")
        case DetectorUpdate():
            check_name(body.file.version, "detector update: detector version")
            _require(len(body.file.sha256) == 32, f"detector update: sha256 has {len(body.file.sha256)} bytes, not 32")


def _check_numbers(record: object) -> None:
    for path, number, low, high in _LIMITS.get(type(record), ()):
        value = number(record)
        if not low <= value <= high:  # true for NaN
            raise PacketError(f"{type(record).__name__}: {path} is {value}, not in {low:.7g}..{high:.7g}")


def check_name(name: str, what: str) -> None:
    """Refuse a name that is not 1 to 64 letters, digits and ``. _ + -``."""
    _require(NAME.fullmatch(name) is not None, f"{what}: {name[:64]!r} is not a name (1-64 of A-Z a-z 0-9 . _ + -)")


def _check_hello(hello: Hello) -> None:
    count = len(hello.lasers)
    _require(0 < count <= limits.MAXIMUM_LASERS, f"hello: {count} lasers, not in 1..{limits.MAXIMUM_LASERS}")
    for laser in hello.lasers:
        _check_beams(laser.beams)
        _check_numbers(laser)
        _check_pose(np.array(laser.T_base_laser), "laser: T_base_laser")
    for channel, version in hello.detector_versions.items():
        check_name(version, f"hello: detector version of {channel}")
    if hello.floor:
        check_floor(hello.floor)


def check_floor(floor: str) -> None:
    """Refuse a floor that is not 1 to 16 letters, digits and ``. _ + -``; "-1" is one."""
    _require(FLOOR.fullmatch(floor) is not None, f"floor {floor[:64]!r} is not 1 to 16 of A-Z a-z 0-9 . _ + -")


def _check_beams(beams: Beams) -> None:
    _check_numbers(beams)
    _require(beams.angle_increment_rad != 0.0, "beams do not turn")
    _require(abs(beams.span_rad) <= LARGEST_SPAN_RAD, "beams cover over a full turn")


def _check_keyscan(keyscan: Keyscan) -> None:
    _require(math.isfinite(keyscan.stamp), "keyscan: stamp is not finite")
    ranges = keyscan.ranges_m
    _require(ranges.ndim == 1, f"keyscan: ranges have shape {ranges.shape}, not (N,)")
    _require(len(ranges) <= limits.MAXIMUM_BEAMS, f"keyscan: {len(ranges)} ranges, at most {limits.MAXIMUM_BEAMS}")
    if not np.array_equal(ranges, dequantise(quantise(ranges))):
        raise PacketError("keyscan: ranges are not quantised; work with dequantise(quantise(ranges_m))")
    if keyscan.beams is not None:
        _check_beams(keyscan.beams)
        count = keyscan.beams.beam_count
        _require(count == len(ranges), f"keyscan: {len(ranges)} ranges of {count} beams")
    if keyscan.sweep is not None:
        _check_sweep(keyscan.sweep)


def _check_sweep(sweep: Sweep) -> None:
    _check_numbers(sweep)
    _require(sweep.first_s != sweep.last_s, "keyscan: all beams are at one time")
    for name, numbers, most in zip(("velocity", "acceleration"), sweep[2:], _MOST_MOTION, strict=True):
        within = all(abs(number) <= most for number in numbers)
        _require(within, f"keyscan: the {name} in the sweep exceeds {most:g}")
    _require(sweep == sweep.rounded(), "keyscan: the sweep is not in steps of the wire; work with Sweep.rounded()")


def _check_information(information: FloatArray, what: str, freedom: int = 3) -> None:
    """Refuse a matrix that is not symmetric or, as rounded and with a unit diagonal, not clearly positive definite."""
    _check_shape(information, (freedom, freedom), f"{what}: information")
    sent = pack_information(information)
    _require(all(map(math.isfinite, sent)), f"{what}: information is not finite")
    rounded, given = unpack_information(sent), information.tolist()
    rows = rounded.tolist()
    diagonal = [row[k] for k, row in enumerate(rows)]
    bounded = min(diagonal) >= limits.MINIMUM_INFORMATION and max(diagonal) <= limits.MAXIMUM_INFORMATION
    _require(bounded, f"{what}: a diagonal element of information is not in [2^-20, 2^40]")
    lower = [(given[k][j] - rows[k][j], diagonal[k] * diagonal[j]) for k in range(freedom) for j in range(k)]
    symmetric = all(off * off <= 1e-12 * scale2 for off, scale2 in lower)  # the upper triangle is sent
    _require(symmetric, f"{what}: information is not symmetric")
    try:
        np.linalg.cholesky(rounded * _without_least(freedom))
    except np.linalg.LinAlgError:
        raise PacketError(f"{what}: information is not clearly positive definite") from None


@cache
def _without_least(freedom: int) -> FloatArray:
    """Factors (d, d) that take the least eigenvalue off a matrix that has a unit diagonal, and as much off others."""
    return frozen(1.0 - limits.MINIMUM_CORRELATION_EIGENVALUE * np.eye(freedom))


def _check_voxel_map(local: VoxelMap) -> None:
    _check_span(local, "voxel map")
    _check_space_pose(local.T_base_ground, "voxel map: T_base_ground")
    for name, most in (("points", MOST_POINTS), ("origins", limits.MAXIMUM_ORIGINS)):
        steps = getattr(local, name)
        _check_shape(steps, (len(steps), 3), f"voxel map: {name}")
        _require(steps.dtype == np.int16, f"voxel map: {name} are {steps.dtype}, not int16")
        _require(0 < len(steps) <= most, f"voxel map: {len(steps)} {name}, not in 1..{most}")
        _require(are_inside(steps), f"voxel map: {name} are outside the bounds")
    _require(bool((np.diff(voxel_keys(local.points)) > 0).all()), "voxel map: voxels are not in ascending order")
    _check_shape(local.seen_from, (len(local.points),), "voxel map: seen_from")
    _require(local.seen_from.dtype == np.uint8, f"voxel map: seen_from are {local.seen_from.dtype}, not bytes")
    is_known = int(local.seen_from.max()) < len(local.origins)
    _require(is_known, "voxel map: a point was seen from an origin that is not there")


def _check_span(body: Place | VoxelMap, what: str) -> None:
    _require(body.first <= body.last, f"{what}: first = {body.first} is after last = {body.last}")
    within = body.first <= body.id.number <= body.last
    _require(within, f"{what}: number = {body.id.number} is not in {body.first}..{body.last}")


def _check_motion(pose: FloatArray, what: str) -> None:
    """Check a pose in the plane or in space."""
    if pose.shape == (7,):
        _check_space_pose(pose, what)
    else:
        _check_pose(pose, what, math.pi)


def _check_space_pose(pose: FloatArray, what: str) -> None:
    _check_shape(pose, (7,), what)
    within = bool((np.abs(pose[:3]) <= limits.MAXIMUM_COORDINATE_M).all())
    _require(within, f"{what}: not within {limits.MAXIMUM_COORDINATE_M:g} m")
    is_near = bool((np.abs(pose[3:]) <= 1.0).all())
    is_unit = is_near and abs(float(np.linalg.norm(pose[3:])) - 1.0) <= 1e-9 and pose[6] >= 0.0
    _require(is_unit, f"{what}: not a unit quaternion with qw >= 0")


def _check_place(place: Place) -> None:
    _check_span(place, "place")
    check_name(place.detector_version, "place: detector version")
    count = len(place.keypoints)
    _require(count <= limits.MAXIMUM_KEYPOINTS, f"place: {count} keypoints, at most {limits.MAXIMUM_KEYPOINTS}")
    _check_shape(place.keypoints, (count, limits.KEYPOINT_AXES[place.channel]), "place: keypoints")
    within = bool((np.abs(place.keypoints) <= MAXIMUM_KEYPOINT_M).all())
    _require(within, f"place: a keypoint is not within {MAXIMUM_KEYPOINT_M:g} m")
    _check_shape(place.descriptors, (count, CODE_BYTES), "place: descriptors")
    _require(place.descriptors.dtype == np.uint8, f"place: descriptors are {place.descriptors.dtype}, not bytes")


def _check_pose(pose: FloatArray, what: str, maximum_angle_rad: float = FULL_TURN_RAD) -> None:
    _check_shape(pose, (3,), what)
    x, y, theta = pose.tolist()
    within = abs(x) <= limits.MAXIMUM_COORDINATE_M and abs(y) <= limits.MAXIMUM_COORDINATE_M
    _require(within, f"{what}: not within {limits.MAXIMUM_COORDINATE_M:g} m")
    _require(abs(theta) <= maximum_angle_rad, f"{what}: the angle is beyond {maximum_angle_rad:.4f} rad")


def _check_shape(array: NDArray[Any], shape: tuple[int, ...], what: str) -> None:
    _require(array.shape == shape, f"{what} have shape {array.shape}, not {shape}")


def _require(condition: bool, reason: str) -> None:
    """Every condition is written so that NaN fails it."""
    if not condition:
        raise PacketError(reason)
