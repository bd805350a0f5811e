"""Laws of encode and decode, and the golden files."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from fcslam.errors import PacketError
from fcslam.geometry.voxels import voxelised
from fcslam.records import Constraint, Keyscan, Place, TagSighting, VoxelMap
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.limits import VERSION
from fcslam.wire.messages import Packet, PacketKind
from fcslam.wire.packets import Label, decode, encode, read_label, unpacked_size
from tests.wire.examples import EXAMPLES, GOLDEN, LIDAR_PLACE, ODOMETRY, VOXEL_MAP, packet, same
from tests.wire.strategies import informations, packets

pytestmark = pytest.mark.slow


@settings(max_examples=200)
@given(packets())
def test_a_packet_comes_back(sent):
    received = decode(encode(sent))
    body = received.body
    if isinstance(body, Place):
        assert np.abs(body.keypoints - sent.body.keypoints).max(initial=0.0) <= 0.00502
        body = replace(body, keypoints=sent.body.keypoints)
    if isinstance(body, Constraint | TagSighting):
        np.testing.assert_allclose(body.information, sent.body.information, rtol=1e-6, atol=1e-30)
        body = replace(body, information=sent.body.information)
    assert same(replace(received, body=body), sent)


def test_keypoints_travel_in_ascending_order_and_their_descriptors_with_them():
    rng = np.random.default_rng(0)
    keypoints = rng.integers(-3, 4, (200, 2)).astype(np.float32)
    codes = rng.integers(0, 256, (200, 32), np.uint8)
    body = decode(encode(packet(replace(LIDAR_PLACE, keypoints=keypoints, descriptors=codes)))).body
    rows = [(*point, bytes(code)) for point, code in zip(keypoints.tolist(), codes, strict=True)]
    received = [(*point, bytes(code)) for point, code in zip(body.keypoints.tolist(), body.descriptors, strict=True)]
    assert received == sorted(rows, key=lambda row: row[:2]), "those at one point stay in their order"


@given(packets())
def test_a_packet_counts_for_what_it_unpacks_to(sent):
    data, body = encode(sent), sent.body
    plain = 2 * len(body.ranges_m) if isinstance(body, Keyscan) else 0
    if isinstance(body, Place):
        plain = 2 * body.keypoints.size + body.descriptors.size
    plain += 5 * len(body.points) if isinstance(body, VoxelMap) else 0
    assert len(data) + plain <= unpacked_size(data) <= len(data) + 1.4 * plain
    assert unpacked_size(data + b"!") == len(data) + 1


@given(packets())
def test_what_was_received_is_sent_on_unchanged(sent):
    data = encode(sent)
    assert encode(decode(data)) == data
    assert same(decode(encode(decode(data))), decode(data))


@given(informations())
def test_information_stays_positive_definite(information):
    body = decode(encode(packet(replace(ODOMETRY, information=information)))).body
    assert np.linalg.eigvalsh(body.information)[0] > 0.0
    assert np.array_equal(body.information, body.information.T)


def test_the_canonical_order_is_time_robot_epoch_sequence():
    keys = [(1.0, "bob", 0, 0), (2.0, "alice", 1, 1), (2.0, "bob", 0, 9), (2.0, "bob", 1, 2), (2.0, "bob", 1, 10)]
    arrived = [Packet(robot, epoch, sequence, time, ODOMETRY) for time, robot, epoch, sequence in reversed(keys)]
    assert [each.order for each in sorted(arrived, key=lambda each: each.order)] == keys


@pytest.mark.parametrize("name", EXAMPLES)
def test_golden_file_is_the_example_with_its_label_and_read_only_arrays(name):
    sent, data = EXAMPLES[name], (GOLDEN / f"{name}.bin").read_bytes()
    received = decode(data)
    assert same(received, sent)
    assert encode(sent) == data
    kind = PacketKind(re.sub(r"(?<!^)([A-Z])", r"_\1", type(sent.body).__name__).lower())
    assert read_label(data) == Label(sent.robot, kind, getattr(sent.body, "channel", None))
    values = [getattr(received.body, field) for field in received.body.__slots__]
    assert not any(value.flags.writeable for value in values if isinstance(value, np.ndarray))


def test_every_kind_has_a_golden_file():
    assert {path.stem for path in GOLDEN.iterdir()} == set(EXAMPLES)
    assert {read_label(encode(example)).kind for example in EXAMPLES.values()} == set(PacketKind)
    assert {field.name for field in pb.Packet.DESCRIPTOR.oneofs_by_name["body"].fields} == set(PacketKind)


def test_read_label_reads_no_body():
    data = pb.Packet(version=VERSION, robot="bob", keyscan=pb.Keyscan(count=9, ranges=b"broken")).SerializeToString()
    assert read_label(data) == Label("bob", PacketKind.KEYSCAN)
    with pytest.raises(PacketError):
        decode(data)


def test_the_largest_packets_fit():
    """A place with the most keypoints, a keyscan with the most ranges and a voxel map as dense as they get."""
    keypoints = np.full((2048, 2), 327.67, np.float32)
    place = replace(LIDAR_PLACE, keypoints=keypoints, descriptors=np.full((2048, 32), 255, np.uint8))
    assert same(decode(encode(packet(place))).body, place)
    ranges = np.resize(np.array([0.0, 131.068, np.inf], np.float32), 4096)
    keyscan = Keyscan(LIDAR_PLACE.id, 0.0, ranges)
    assert same(decode(encode(packet(keyscan))).body, keyscan)
    walls = np.random.default_rng(0).uniform((-8.0, -8.0, 0.0), (8.0, 8.0, 3.0), (100_000, 3))
    walls[:, 0] = np.round(walls[:, 0] / 2.0) * 2.0
    points, seen_from = voxelised(walls, np.arange(len(walls)) % 2, VOXEL_MAP.origins_m)
    local = replace(VOXEL_MAP, points=points, seen_from=seen_from)
    assert len(local.points) > 30_000
    assert same(decode(encode(packet(local))).body, local)
