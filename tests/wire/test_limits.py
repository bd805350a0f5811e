"""Every limit, on the way in and on the way out."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fcslam.errors import PacketError
from fcslam.records import Beams, Channel, KeyscanId
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.limits import MINIMUM_CORRELATION_EIGENVALUE, MINIMUM_INFORMATION, VERSION
from fcslam.wire.packets import decode, encode
from fcslam.wire.streams import pack_ranges
from tests.wire.examples import (
    ACKNOWLEDGEMENT,
    CLOSURE,
    CORRECTION,
    DETECTOR_UPDATE,
    EXAMPLES,
    HELLO,
    KEYSCAN,
    LIDAR_PLACE,
    SPACE_ODOMETRY,
    VARIED_KEYSCAN,
    VOXEL_MAP,
    packet,
    same,
)

NAN, INF = float("nan"), float("inf")


def information(*diagonal, xy=0.0, yx=None):
    matrix = np.diag(diagonal)
    matrix[0, 1], matrix[1, 0] = xy, xy if yx is None else yx
    return matrix


def place(count, positions=None, codes=None):
    return replace(
        LIDAR_PLACE,
        keypoints=np.zeros((count, 2), np.float32) if positions is None else positions,
        descriptors=np.zeros((count, 32), np.uint8) if codes is None else codes,
    )


def hello(**laser):
    return replace(HELLO, lasers=(replace(HELLO.lasers[0], **laser),))


def beams(*, count=14, first=-1.25, increment=0.0078125):
    return replace(KEYSCAN, beams=Beams(count, first, increment))


def detector_update(**changes):
    return replace(DETECTOR_UPDATE, file=replace(DETECTOR_UPDATE.file, **changes))


REFUSED_BODIES = [
    (replace(HELLO, robot="bob"), "holds a record of robot"),
    (replace(HELLO, epoch=8), "epoch 8 in a packet of epoch 7"),
    (replace(HELLO, detector_versions={Channel.LIDAR: "two words"}), "detector version of lidar"),
    (replace(HELLO, lasers=()), "0 lasers"),
    (replace(HELLO, lasers=9 * HELLO.lasers[:1]), "9 lasers"),
    (hello(beam_count=0), "beam_count is 0"),
    (hello(beam_count=4097), "beam_count is 4097"),
    (hello(angle_min_rad=NAN), "angle_min_rad"),
    (hello(angle_increment_rad=0.0), "do not turn"),
    (hello(angle_increment_rad=NAN), "increment_rad"),
    (hello(angle_increment_rad=-0.036), "over a full turn"),
    (hello(max_range_m=0.0), "max_range_m"),
    (hello(max_range_m=INF), "max_range_m"),
    (hello(T_base_laser=(0.0, NAN, 0.0)), "T_base_laser"),
    (replace(KEYSCAN, id=KeyscanId("bob", 0)), "holds a record of robot"),
    (replace(KEYSCAN, id=KeyscanId("alice", 2**31)), "number"),
    (replace(KEYSCAN, stamp=NAN), "stamp is not finite"),
    (replace(KEYSCAN, stamp=1042.75), "later than"),
    (replace(VARIED_KEYSCAN, ranges_m=np.zeros(0, np.float32)), "0 ranges of 14 beams"),
    (replace(KEYSCAN, ranges_m=np.zeros(4097, np.float32)), "4097 ranges"),
    (replace(KEYSCAN, ranges_m=np.array([1.001], np.float32)), "not quantised"),
    (replace(KEYSCAN, ranges_m=np.array([NAN], np.float32)), "not quantised"),
    (replace(KEYSCAN, laser=8), "laser is 8"),
    (beams(count=13), "14 ranges of 13 beams"),
    (beams(increment=0.5), "over a full turn"),
    (replace(CLOSURE, i=12), "not below"),
    (replace(CLOSURE, T_i_j=np.array([0.0, 0.0, 3.2])), "angle"),
    (replace(CLOSURE, T_i_j=np.array([1.1e6, 0.0, 0.0])), "not within"),
    (replace(CLOSURE, T_i_j=np.zeros(4)), "shape"),
    (replace(CLOSURE, information=information(1.0, NAN, 1.0)), "not finite"),
    (replace(CLOSURE, information=information(1.0, 1.2e12, 1.0)), "diagonal"),
    (replace(CLOSURE, information=information(1.0, 9e-7, 1.0)), "diagonal"),
    (replace(CLOSURE, information=information(1.0, 1.0, 1.0, xy=0.5, yx=0.4)), "symmetric"),
    (replace(CLOSURE, information=information(1.0, 1.0, 1.0, xy=0.5, yx=NAN)), "symmetric"),
    (replace(CLOSURE, information=information(1.0, 1.0, 1.0, xy=1.5)), "positive definite"),
    (replace(CLOSURE, information=information(1e4, 1e4, 1.0, xy=1e4 * (1.0 - 5e-7))), "clearly positive definite"),
    (replace(SPACE_ODOMETRY, T_i_j=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.1])), "unit quaternion"),
    (replace(SPACE_ODOMETRY, T_i_j=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])), "unit quaternion"),
    (replace(SPACE_ODOMETRY, T_i_j=np.array([0.0, 0.0, NAN, 0.0, 0.0, 0.0, 1.0])), "not within"),
    (replace(SPACE_ODOMETRY, information=np.eye(3)), "shape"),
    (replace(SPACE_ODOMETRY, information=np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 2.0**41])), "diagonal"),
    (replace(SPACE_ODOMETRY, information=np.eye(6) + 1e-3 * np.eye(6, k=1)), "symmetric"),
    (replace(SPACE_ODOMETRY, information=np.ones((6, 6))), "clearly positive definite"),
    (replace(SPACE_ODOMETRY, information=np.full((6, 6), NAN)), "not finite"),
    (replace(VOXEL_MAP, first=13), "after last"),
    (replace(VOXEL_MAP, last=11), "not in 2..11"),
    (replace(VOXEL_MAP, points=VOXEL_MAP.points[::-1]), "ascending"),
    (replace(VOXEL_MAP, points=VOXEL_MAP.points[[0, 0]]), "ascending"),
    (replace(VOXEL_MAP, points=np.array([[640, 0, 0]], np.int16)), "outside the bounds"),
    (replace(VOXEL_MAP, points=VOXEL_MAP.points.astype(np.int32)), "not int16"),
    (replace(VOXEL_MAP, points=VOXEL_MAP.points[:0]), "0 points"),
    (replace(VOXEL_MAP, origins=np.zeros((257, 3), np.int16)), "257 origins"),
    (replace(VOXEL_MAP, seen_from=VOXEL_MAP.seen_from[:4]), "seen_from have shape"),
    (replace(VOXEL_MAP, seen_from=np.full(5, 2, np.uint8)), "origin that is not there"),
    (replace(VOXEL_MAP, T_base_ground=np.array([0.0, 0.0, 0.0])), "shape"),
    (replace(LIDAR_PLACE, first=13), "after last"),
    (replace(LIDAR_PLACE, detector_version=""), "detector version"),
    (place(2049), "2049 keypoints"),
    (place(2, codes=np.zeros((3, 32), np.uint8)), "descriptors have shape"),
    (place(2, positions=np.zeros((2, 3), np.float32)), "keypoints have shape"),
    (place(1, positions=np.array([[327.7, 0.0]], np.float32)), "not within"),
    (place(1, positions=np.array([[0.0, NAN]], np.float32)), "not within"),
    (replace(CORRECTION, version=-1), "version"),
    (replace(CORRECTION, map_index=-1), "map_index"),
    (replace(CORRECTION, quality=1.01), "quality"),
    (replace(CORRECTION, quality=NAN), "quality"),
    (replace(CORRECTION, T_map_odom=np.array([NAN, 0.0, 0.0])), "not within"),
    (replace(ACKNOWLEDGEMENT, sequence=2**63), "sequence"),
    (detector_update(version="a b"), "detector version"),
    (detector_update(format=-1), "format"),
    (detector_update(size=0), "file.size is 0"),
    (detector_update(size=2**26 + 1), "file.size"),
    (detector_update(sha256=bytes(31)), "31 bytes"),
]


@given(hnp.arrays(np.float64, (3, 3), elements=st.floats(-1.0, 1.0)), st.floats(1e-9, 1e-3))
def test_information_is_written_if_its_correlations_have_no_small_eigenvalue(root, ridge):
    covariance = root @ root.T + ridge * np.eye(3)
    sent = covariance.astype(np.float32).astype(np.float64)
    deviation = np.sqrt(sent.diagonal())
    smallest = np.linalg.eigvalsh(sent / np.outer(deviation, deviation))[0]
    assume(sent.diagonal().min() >= MINIMUM_INFORMATION and abs(smallest - MINIMUM_CORRELATION_EIGENVALUE) > 1e-12)
    closure = packet(replace(CLOSURE, information=covariance))
    if smallest > MINIMUM_CORRELATION_EIGENVALUE:
        encode(closure)
    else:
        with pytest.raises(PacketError, match="clearly positive definite"):
            encode(closure)


@pytest.mark.parametrize(("body", "reason"), REFUSED_BODIES)
def test_a_body_beyond_a_limit_is_not_written(body, reason):
    with pytest.raises(PacketError, match=reason):
        encode(packet(body))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"robot": ""}, "is not a name"),
        ({"robot": "a" * 65}, "is not a name"),
        ({"robot": "../alice"}, "is not a name"),
        ({"robot": ".alice"}, "is not a name"),
        ({"robot": "alicé"}, "is not a name"),
        ({"robot": "alice\n"}, "is not a name"),
        ({"epoch": -1}, "epoch"),
        ({"epoch": 2**31}, "epoch"),
        ({"sequence": -1}, "sequence"),
        ({"time": NAN}, "time"),
        ({"time": INF}, "time"),
    ],
)
def test_an_envelope_beyond_a_limit_is_not_written(change, reason):
    with pytest.raises(PacketError, match=reason):
        encode(replace(EXAMPLES["correction"], **change))


ALLOWED_BODIES = [
    hello(beam_count=4096, angle_increment_rad=-0.0015),
    hello(beam_count=361, angle_increment_rad=np.pi / 180.0),
    replace(HELLO, detector_versions={}),
    replace(KEYSCAN, stamp=1042.5),
    replace(CLOSURE, T_i_j=np.array([1e6, -1e6, -np.pi])),
    replace(CLOSURE, information=information(2.0**40, 2.0**-20, 1.0)),
    place(0),
    place(2048),
    replace(ACKNOWLEDGEMENT, sequence=2**63 - 1),
    detector_update(size=2**26, format=2**31 - 1),
]


@pytest.mark.slow
@pytest.mark.parametrize("body", ALLOWED_BODIES)
def test_a_body_at_a_limit_is_written_and_read(body):
    assert same(decode(encode(packet(body))).body, body)


def changed(name, **fields):
    """A valid example whose message is changed behind the back of ``encode``."""
    message = pb.Packet.FromString(encode(EXAMPLES[name]))
    body = getattr(message, message.WhichOneof("body"))
    for field, value in fields.items():
        target = message if field in ("version", "robot", "epoch", "sequence", "time") else body
        if value is None:
            target.ClearField(field)
        elif isinstance(value, list):
            target.ClearField(field)
            getattr(target, field).extend(value)
        elif isinstance(value, pb.Pose | pb.Beams):
            getattr(target, field).CopyFrom(value)
        else:
            setattr(target, field, value)
    return message.SerializeToString()


def laser(**fields):
    message = pb.Packet.FromString(encode(EXAMPLES["hello"])).hello.lasers[0]
    for field, value in fields.items():
        if isinstance(value, pb.Pose):
            getattr(message, field).CopyFrom(value)
        else:
            setattr(message, field, value)
    return message


LIDAR, CAMERA = pb.Detector(channel=1, version="a"), pb.Detector(channel=2, version="b")


@pytest.mark.parametrize(
    ("name", "fields", "reason"),
    [
        ("hello", {"version": 0}, "version 0 is unknown, this side speaks versions 10 and 11"),
        ("keyscan", {"version": 9}, "version 9 is unknown"),
        ("floor_hello", {"floor": "two words"}, "floor 'two words' is not 1 to 16"),
        ("hello", {"robot": "a/b"}, "is not a name"),
        ("hello", {"epoch": 2**31}, "epoch"),
        ("hello", {"sequence": 2**64 - 1}, "sequence"),
        ("hello", {"lasers": 5000 * [pb.Laser()]}, "lasers: 5000, at most 8"),
        ("hello", {"lasers": [laser(beam_count=2**32 - 1)]}, "beam_count"),
        ("hello", {"lasers": [pb.Laser(beam_count=9)]}, "t_base_laser is missing"),
        ("hello", {"detectors": [CAMERA, LIDAR]}, "ascending"),
        ("hello", {"detectors": [LIDAR, LIDAR]}, "ascending"),
        ("hello", {"detectors": [LIDAR, pb.Detector(channel=7, version="a")]}, "channel 7 is unknown"),
        ("keyscan", {"ranges": bytes(29)}, "29 bytes, at most 28"),
        ("keyscan", {"ranges": b"\x01\x02\x03\x00"}, "not a deflated stream|ends early or has bytes"),
        ("keyscan", {"count": 4097, "ranges": bytes(2 * 4097)}, "4097, at most 4096"),
        ("keyscan", {"ranges": pack_ranges(np.zeros(14, np.uint16)) + b"x"}, "has bytes after its end"),
        ("keyscan", {"beams": pb.Beams(angle_min_rad=NAN, angle_increment_rad=0.01)}, "angle_min_rad"),
        ("keyscan", {"beams": pb.Beams(angle_increment_rad=1e9)}, "angle_increment_rad"),
        (
            "varied_keyscan",
            {"count": 15, "ranges": bytes(30), "beams": pb.Beams(angle_increment_rad=0.6)},
            "over a full",
        ),
        ("closure", {"kind": 9}, "kind 9 is unknown"),
        ("closure", {"t_i_j": None}, "t_i_j is missing"),
        ("closure", {"information": [1.0, 0.0, 0.0, 1.0, 0.0]}, "5 numbers"),
        ("space_odometry", {"version": 10}, "of version 11 says that it is of version 10"),
        ("odometry", {"version": 11}, "of version 10 says that it is of version 11"),
        ("space_odometry", {"t_i_j": pb.Pose(x_m=1.0)}, "t_i_j is there twice"),
        ("space_odometry", {"information": 6 * [1.0]}, "6 numbers, not 21"),
        ("voxel_map", {"t_base_ground": None}, "t_base_ground is missing"),
        ("voxel_map", {"count": 0, "points": b""}, "0 points"),
        ("voxel_map", {"count": 32769}, "32769, at most 32768"),
        ("voxel_map", {"points": bytes(26)}, "points: 26 bytes, at most 25"),
        ("voxel_map", {"points": bytes(25)}, "ascending"),
        ("voxel_map", {"points": 25 * b"\xff"}, "outside its bounds"),
        ("voxel_map", {"origins": [1, 2]}, "origin is incomplete"),
        ("voxel_map", {"origins": [2**31 - 1, 0, 0]}, "outside the bounds"),
        ("lidar_place", {"channel": 3}, "channel 3 is unknown"),
        ("lidar_place", {"descriptors": bytes(97)}, "descriptors: 97 bytes, at most 96"),
        ("lidar_place", {"descriptors": bytes(64)}, "descriptors: not a deflated stream"),
        ("lidar_place", {"keypoints": bytes(13)}, "keypoints: 13 bytes, at most 12"),
        ("lidar_place", {"count": 2}, "at most 8"),
        ("lidar_place", {"count": 2049}, "keypoints: 2049, at most 2048"),
        ("lidar_place", {"keypoints": bytes(6) + b"\x80" + bytes(5)}, "beyond 32,767 steps"),
        ("lidar_place", {"keypoints": b"\x01\xff" + bytes(4) + b"\x00\xff" + bytes(4)}, "ascending order"),
        ("tag_sighting", {"family": "apriltag_99h9"}, "family 'apriltag_99h9' is unknown"),
        ("tag_sighting", {"tag": 4096}, "tag.number is 4096"),
        ("tag_sighting", {"t_base_tag": None}, "t_base_tag is missing"),
        ("keyscan_fix", {"latitude_deg": 90.5}, "_deg is"),
        ("keyscan_fix", {"longitude_deg": NAN}, "_deg is"),
        ("keyscan_fix", {"altitude_m": INF}, "altitude"),
        ("keyscan_fix", {"sigma_m": 0.0}, "sigma_m is"),
        ("keyscan_fix", {"antenna_x_m": 2e3}, "antenna"),
        ("correction", {"t_map_odom": None}, "t_map_odom is missing"),
        ("correction", {"version": 2**31}, "version"),
        ("correction", {"map_index": 2**31}, "map_index"),
        ("detector_update", {"size": 2**63}, "file.size"),
    ],
)
def test_a_message_beyond_a_limit_is_not_read(name, fields, reason):
    with pytest.raises(PacketError, match=reason):
        decode(changed(name, **fields))


def test_only_whole_known_messages_are_read():
    data = encode(EXAMPLES["closure"])
    unknown_field = b"\xfa\x07\x03abc"
    for broken, reason in [
        (b"", "version 0"),
        (data[:-1], "not a protobuf"),
        (data + unknown_field, "unknown, repeated"),
        (data + data, "unknown, repeated"),
        (data + b"\x18\x87\x00", "unknown, repeated"),  # epoch 7 again, in an overlong varint
        (pb.Packet(version=VERSION, robot="alice").SerializeToString(), "empty"),
        (data + bytes(96 * 1024), "at most 98304"),
    ]:
        with pytest.raises(PacketError, match=reason):
            decode(broken)


def test_a_reason_quotes_little_of_a_hostile_name():
    with pytest.raises(PacketError) as caught:
        decode(changed("hello", robot="\n" * 50_000))
    assert len(str(caught.value)) < 250
    assert "\n" not in str(caught.value)
