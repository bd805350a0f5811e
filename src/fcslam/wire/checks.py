"""Validation of packets: the same checks before writing and after reading."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import PacketError
from fcslam.geometry.beams import FULL_TURN_RAD, LARGEST_SPAN_RAD
from fcslam.records import (
    CODE_BYTES,
    FLOOR,
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
)
from fcslam.wire import limits
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet
from fcslam.wire.quantisation import MAXIMUM_KEYPOINT_M, dequantise, pack_information, quantise

_OF_KEYSCANS = Keyscan | Place | TagSighting | KeyscanFix


def check(packet: Packet) -> None:
    """Refuse a packet that violates the format."""
    check_name(packet.robot, "robot")
    _check_count(packet.epoch, "epoch", limits.MAXIMUM_EPOCH)
    _check_count(packet.sequence, "sequence", limits.MAXIMUM_SEQUENCE)
    _require(math.isfinite(packet.time), "time is not finite")
    robot = packet.body.id.robot if isinstance(packet.body, _OF_KEYSCANS) else packet.body.robot
    if robot != packet.robot:
        raise PacketError(f"a packet of robot {packet.robot} holds a record of robot {robot!r}")
    _CHECKS[type(packet.body)](packet.body, packet)


def check_name(name: str, what: str) -> None:
    """Refuse a name that is not 1 to 64 letters, digits and ``. _ + -``."""
    if NAME.fullmatch(name) is None:
        raise PacketError(f"{what}: {name[:64]!r} is not a name (1-64 of A-Z a-z 0-9 . _ + -)")


def _check_hello(hello: Hello, packet: Packet) -> None:
    _require(hello.epoch == packet.epoch, f"hello: epoch {hello.epoch} in a packet of epoch {packet.epoch}")
    count = len(hello.lasers)
    _require(0 < count <= limits.MAXIMUM_LASERS, f"hello: {count} lasers, not in 1..{limits.MAXIMUM_LASERS}")
    for laser in hello.lasers:
        _check_laser(laser)
    for channel, version in hello.detector_versions.items():
        check_name(version, f"hello: detector version of {channel}")
    if hello.floor:
        check_floor(hello.floor)


def check_floor(floor: str) -> None:
    """Refuse a floor that is not 1 to 16 letters, digits and ``. _ + -``; "-1" is one."""
    _require(FLOOR.fullmatch(floor) is not None, f"floor {floor[:64]!r} is not 1 to 16 of A-Z a-z 0-9 . _ + -")


def _check_laser(laser: LaserModel) -> None:
    _check_beams(laser.beams, "laser")
    _require(0.0 < laser.max_range_m <= limits.MAXIMUM_LASER_RANGE_M, "laser: maximum range is not in (0, 1000] m")
    _check_pose(np.array(laser.T_base_laser), "laser: T_base_laser")


def _check_beams(beams: Beams, what: str) -> None:
    count, first, increment = beams
    _require(0 < count <= limits.MAXIMUM_BEAMS, f"{what}: {count} beams, not in 1..{limits.MAXIMUM_BEAMS}")
    _require(abs(first) <= FULL_TURN_RAD, f"{what}: first beam is not within a full turn")
    turns = 0.0 < abs(increment) <= FULL_TURN_RAD
    _require(turns, f"{what}: beams do not turn, or by more than a full turn")
    within = abs(increment) * (count - 1) <= LARGEST_SPAN_RAD
    _require(within, f"{what}: beams cover over a full turn")


def _check_keyscan(keyscan: Keyscan, packet: Packet) -> None:
    _check_count(keyscan.id.number, "keyscan: number")
    _require(math.isfinite(keyscan.stamp), "keyscan: stamp is not finite")
    _require(keyscan.stamp <= packet.time, "keyscan: stamp is later than the packet's time")
    ranges = keyscan.ranges_m
    _require(ranges.ndim == 1, f"keyscan: ranges have shape {ranges.shape}, not (N,)")
    _require(len(ranges) <= limits.MAXIMUM_BEAMS, f"keyscan: {len(ranges)} ranges, at most {limits.MAXIMUM_BEAMS}")
    if not np.array_equal(ranges, dequantise(quantise(ranges))):
        raise PacketError("keyscan: ranges are not quantised; work with dequantise(quantise(ranges_m))")
    _check_count(keyscan.laser, "keyscan: laser", limits.MAXIMUM_LASERS - 1)
    if keyscan.beams is not None:
        _check_beams(keyscan.beams, "keyscan")
        count = keyscan.beams.beam_count
        _require(count == len(ranges), f"keyscan: {len(ranges)} ranges of {count} beams")
    if keyscan.sweep is not None:
        _check_sweep(keyscan.sweep)


def _check_sweep(sweep: Sweep) -> None:
    times = sweep.first_s, sweep.last_s
    within = all(abs(t) <= limits.MAXIMUM_BEAM_TIME_S for t in times) and sweep.first_s != sweep.last_s
    _require(within, f"keyscan: beams at {times} s, not two times within {limits.MAXIMUM_BEAM_TIME_S:g} s of the stamp")
    slow = all(abs(number) <= limits.MAXIMUM_SPEED for number in sweep.velocity)
    _require(slow, f"keyscan: the velocity in the sweep exceeds {limits.MAXIMUM_SPEED:g} m/s or rad/s")
    steady = all(abs(number) <= limits.MAXIMUM_ACCELERATION for number in sweep.acceleration)
    _require(steady, f"keyscan: the acceleration in the sweep exceeds {limits.MAXIMUM_ACCELERATION:g} m/s^2 or rad/s^2")
    _require(sweep == sweep.rounded(), "keyscan: the sweep is not in steps of the wire; work with Sweep.rounded()")


def _check_constraint(constraint: Constraint, _: Packet) -> None:
    _check_count(constraint.i, "constraint: i")
    _check_count(constraint.j, "constraint: j")
    _require(constraint.i < constraint.j, f"constraint: i = {constraint.i} is not below j = {constraint.j}")
    _check_pose(constraint.T_i_j, "constraint: T_i_j", math.pi)
    _check_information(constraint.information, "constraint")


def _check_information(information: FloatArray, what: str) -> None:
    """Refuse a matrix that is not symmetric or, as rounded and with a unit diagonal, not clearly positive definite."""
    _check_shape(information, (3, 3), f"{what}: information")
    xx, xy, xt, yy, yt, tt = sent = pack_information(information)
    _require(all(map(math.isfinite, sent)), f"{what}: information is not finite")
    bounded = all(limits.MINIMUM_INFORMATION <= diagonal <= limits.MAXIMUM_INFORMATION for diagonal in (xx, yy, tt))
    _require(bounded, f"{what}: a diagonal element of information is not in [2^-20, 2^40]")
    x, y, t = 1.0 / math.sqrt(xx), 1.0 / math.sqrt(yy), 1.0 / math.sqrt(tt)
    scale = (x * x, x * y, x * t, y * x, y * y, y * t, t * x, t * y, t * t)
    given = zip(information.ravel().tolist(), (xx, xy, xt, xy, yy, yt, xt, yt, tt), scale, strict=True)
    symmetric = all(abs(number - rounded) * factor <= 1e-6 for number, rounded, factor in given)
    _require(symmetric, f"{what}: information is not symmetric")
    definite = _exceeds(limits.MINIMUM_CORRELATION_EIGENVALUE, xy * x * y, xt * x * t, yt * y * t)
    _require(definite, f"{what}: information is not clearly positive definite")


def _exceeds(limit: float, xy: float, xt: float, yt: float) -> bool:
    """Whether a matrix (3, 3) with these correlations has no eigenvalue below ``limit`` < 1: without the limit on its
    diagonal, all pivots of its elimination are positive. Without arrays it takes a tenth of the time."""
    first = 1.0 - limit
    second = first - xy * xy / first
    rest = yt - xy * xt / first
    return second > 0.0 and first - xt * xt / first - rest * rest / second > 0.0


def _check_place(place: Place, _: Packet) -> None:
    _check_count(place.id.number, "place: number")
    _check_count(place.first, "place: first")
    _check_count(place.last, "place: last")
    _require(place.first <= place.last, f"place: first = {place.first} is after last = {place.last}")
    within = place.first <= place.id.number <= place.last
    _require(within, f"place: number = {place.id.number} is not in {place.first}..{place.last}")
    check_name(place.detector_version, "place: detector version")
    count = len(place.keypoints)
    _require(count <= limits.MAXIMUM_KEYPOINTS, f"place: {count} keypoints, at most {limits.MAXIMUM_KEYPOINTS}")
    _check_shape(place.keypoints, (count, limits.KEYPOINT_AXES[place.channel]), "place: keypoints")
    within = bool((np.abs(place.keypoints) <= MAXIMUM_KEYPOINT_M).all())
    _require(within, f"place: a keypoint is not within {MAXIMUM_KEYPOINT_M:g} m")
    _check_shape(place.descriptors, (count, CODE_BYTES), "place: descriptors")
    _require(place.descriptors.dtype == np.uint8, f"place: descriptors are {place.descriptors.dtype}, not bytes")


def _check_tag_sighting(sighting: TagSighting, _: Packet) -> None:
    _check_count(sighting.id.number, "tag sighting: number")
    _check_count(sighting.tag.number, "tag sighting: tag", limits.MAXIMUM_TAG)
    _check_pose(sighting.T_base_tag, "tag sighting: T_base_tag", math.pi)
    _check_information(sighting.information, "tag sighting")


def _check_fix(fix: KeyscanFix, _: Packet) -> None:
    _check_count(fix.id.number, "fix: number")
    # false for NaN
    latitude, longitude = fix.latitude_deg, fix.longitude_deg
    is_on_earth = abs(latitude) <= limits.MAXIMUM_LATITUDE_DEG and abs(longitude) <= limits.MAXIMUM_LONGITUDE_DEG
    _require(is_on_earth, f"fix: latitude {latitude:g}, longitude {longitude:g} are not on the earth")
    _require(abs(fix.altitude_m) <= limits.MAXIMUM_ALTITUDE_M, f"fix: an altitude of {fix.altitude_m:g} m")
    is_known = 0.0 < fix.sigma_m <= limits.MAXIMUM_FIX_SIGMA_M
    _require(is_known, f"fix: a standard deviation of {fix.sigma_m:g} m, not in 0..{limits.MAXIMUM_FIX_SIGMA_M:g}")
    is_near = math.hypot(*fix.antenna_xy) <= limits.MAXIMUM_ANTENNA_M
    _require(is_near, f"fix: the antenna is not within {limits.MAXIMUM_ANTENNA_M:g} m of the robot")


def _check_correction(correction: Correction, _: Packet) -> None:
    _check_count(correction.version, "correction: version")
    _check_count(correction.map_index, "correction: map index")
    _check_pose(correction.T_map_odom, "correction: T_map_odom", math.pi)
    _require(0.0 <= correction.quality <= 1.0, f"correction: quality {correction.quality} is not within 0 and 1")


def _check_acknowledgement(acknowledgement: Acknowledgement, _: Packet) -> None:
    _check_count(acknowledgement.epoch, "acknowledgement: epoch", limits.MAXIMUM_EPOCH)
    _check_count(acknowledgement.sequence, "acknowledgement: sequence", limits.MAXIMUM_SEQUENCE)


def _check_detector_update(update: DetectorUpdate, _: Packet) -> None:
    file = update.file
    check_name(file.version, "detector update: detector version")
    _check_count(file.format, "detector update: format")
    within = 0 < file.size <= limits.MAXIMUM_NETWORK_BYTES
    _require(within, f"detector update: a file of {file.size} bytes, not of 1..{limits.MAXIMUM_NETWORK_BYTES}")
    sized = len(file.sha256) == limits.DIGEST_BYTES
    _require(sized, f"detector update: sha256 has {len(file.sha256)} bytes, not {limits.DIGEST_BYTES}")


_CHECKS: dict[type, Callable[[Any, Packet], None]] = {
    Hello: _check_hello,
    Keyscan: _check_keyscan,
    Constraint: _check_constraint,
    Place: _check_place,
    TagSighting: _check_tag_sighting,
    KeyscanFix: _check_fix,
    Correction: _check_correction,
    Acknowledgement: _check_acknowledgement,
    DetectorUpdate: _check_detector_update,
}


def _check_pose(pose: FloatArray, what: str, maximum_angle_rad: float = FULL_TURN_RAD) -> None:
    _check_shape(pose, (3,), what)
    x, y, theta = pose.tolist()
    within = abs(x) <= limits.MAXIMUM_COORDINATE_M and abs(y) <= limits.MAXIMUM_COORDINATE_M
    _require(within, f"{what}: not within {limits.MAXIMUM_COORDINATE_M:g} m")
    _require(abs(theta) <= maximum_angle_rad, f"{what}: the angle is beyond {maximum_angle_rad:.4f} rad")


def _check_shape(array: NDArray[Any], shape: tuple[int, ...], what: str) -> None:
    if array.shape != shape:
        raise PacketError(f"{what} have shape {array.shape}, not {shape}")


def _check_count(value: int, what: str, maximum: int = limits.MAXIMUM_NUMBER) -> None:
    if not 0 <= value <= maximum:
        raise PacketError(f"{what} is {value}, not in 0..{maximum}")


def _require(condition: bool, reason: str) -> None:
    """Every condition is written so that NaN fails it."""
    if not condition:
        raise PacketError(reason)
