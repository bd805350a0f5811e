"""The contents that the schema can carry: no image leaves a robot. And that code, schema and document agree."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor

from fcslam.errors import PacketError
from fcslam.geometry.voxels import MOST_POINTS
from fcslam.records import MOST_NETWORK_BYTES, PLACE_CHANNELS, ConstraintKind
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire import limits
from fcslam.wire.packets import decode, encode
from tests.wire.examples import EXAMPLES

ROOT = Path(__file__).parents[2]
SCHEMA = "src/fcslam/wire/fcslam.proto"
DOCUMENTS = sorted((ROOT / "docs/reference").glob("wire*.md"))

NUMBERS = {
    FieldDescriptor.TYPE_DOUBLE,
    FieldDescriptor.TYPE_FLOAT,
    FieldDescriptor.TYPE_UINT32,
    FieldDescriptor.TYPE_UINT64,
    FieldDescriptor.TYPE_ENUM,
    FieldDescriptor.TYPE_SINT32,
}
LONGEST = {
    "Packet.robot": 64,
    "Detector.version": 64,
    "Place.detector_version": 64,
    "DetectorUpdate.version": 64,
    "DetectorUpdate.sha256": 32,
    "Keyscan.ranges": 2 * 4096,
    "Place.keypoints": 6 * 2048,
    "Place.descriptors": 32 * 2048,
    "Hello.lasers": 8,
    "Hello.detectors": 2,
    "Hello.floor": 16,
    "Constraint.information": 21,
    "Keyscan.sweep": 8,
    "VoxelMap.points": 5 * 32768,
    "VoxelMap.origins": 3 * 256,
    "TagSighting.family": 16,
    "TagSighting.information": 6,
}
"""Every field that holds more than one number, and how much of it, in bytes, characters or elements."""


ELEMENTS = {
    "Keyscan.sweep": [1],
    "VoxelMap.origins": [1],
    "Hello.detectors": [pb.Detector(channel=1, version="a")],
    "Hello.lasers": list(pb.Packet.FromString(encode(EXAMPLES["hello"])).hello.lasers[:1]),
}


def reachable(descriptor):
    """Every (message, field) that a packet can hold."""
    for field in descriptor.fields:
        yield field
        if field.message_type:
            yield from reachable(field.message_type)


FIELDS = {f"{field.containing_type.name}.{field.name}": field for field in reachable(pb.Packet.DESCRIPTOR)}


def test_every_field_is_a_number_a_message_or_listed():
    assert {name for name, field in FIELDS.items() if field.type not in NUMBERS or field.is_repeated} == {
        name for name, field in FIELDS.items() if field.message_type and not field.is_repeated
    } | set(LONGEST)


def test_the_schema_has_no_message_besides():
    assert {name.split(".")[0] for name in FIELDS} == set(pb.DESCRIPTOR.message_types_by_name)
    assert not any(
        message.nested_types or message.extensions for message in pb.DESCRIPTOR.message_types_by_name.values()
    )


def filled(name, count):
    """A packet whose field ``name`` holds ``count`` bytes, characters or elements, otherwise valid."""
    for example in EXAMPLES.values():
        message = pb.Packet.FromString(encode(example))
        body = getattr(message, message.WhichOneof("body"))
        for part in (message, body, *getattr(body, "detectors", [])[:1]):
            kind, _, field_name = name.partition(".")
            if part.DESCRIPTOR.name != kind:
                continue
            field = FIELDS[name]
            if field.is_repeated:
                elements = ELEMENTS.get(name, [1.0])
                part.ClearField(field_name)
                getattr(part, field_name).extend(elements * count)
            else:
                setattr(part, field_name, "a" * count if field.type == field.TYPE_STRING else bytes(count))
            return message.SerializeToString()
    raise AssertionError(f"no example has {name}")


@pytest.mark.parametrize("name", LONGEST)
def test_no_field_is_longer_than_listed(name):
    for count in (LONGEST[name] + 1, 2 * LONGEST[name]):
        with pytest.raises(PacketError):
            decode(filled(name, count))


@pytest.mark.parametrize("name", [name for name, field in FIELDS.items() if field.type == field.TYPE_BYTES])
@pytest.mark.parametrize("image", ["raw", "jpeg"])
def test_no_field_of_bytes_takes_an_image(name, image):
    """Not even the smallest camera image, raw (160 x 120 grey) or compressed (noise with a JPEG's head).

    Put in as it is: descriptors without their keypoints are refused. Bytes dressed up as a place would pass.
    """
    noise = np.random.default_rng(0).integers(0, 256, 160 * 120, np.uint8).tobytes()
    data = noise if image == "raw" else b"\xff\xd8\xff\xe0" + noise[:6000]
    message = pb.Packet.FromString(filled(name, 0))
    body = getattr(message, message.WhichOneof("body"))
    kind, _, field_name = name.partition(".")
    setattr(body if body.DESCRIPTOR.name == kind else body.detectors[0], field_name, data)
    with pytest.raises(PacketError):
        decode(message.SerializeToString())


def test_no_image_hides_in_an_unknown_field():
    image = b"\xfa\x07\x88\x27" + bytes(5000)  # field 127 of 5000 bytes
    for example in EXAMPLES.values():
        data = encode(example)
        with pytest.raises(PacketError, match="unknown"):
            decode(data + image)


def test_every_enumeration_is_in_the_schema():
    assert [f"CHANNEL_{each.name}" for each in PLACE_CHANNELS] == pb.Channel.keys()[1:]
    assert [f"CONSTRAINT_KIND_{each.name}" for each in ConstraintKind] == pb.ConstraintKind.keys()[1:]


def test_generating_the_module_anew_changes_nothing(tmp_path):
    """The command of `make proto`, into another folder; the versions of its tools are pinned."""
    pytest.importorskip("grpc_tools")
    arguments = [f"--proto_path={ROOT / 'src'}", f"--python_out={tmp_path}", f"--pyi_out={tmp_path}"]
    command = [sys.executable, "-m", "grpc_tools.protoc", *arguments, "fcslam/wire/fcslam.proto"]
    subprocess.run(command, cwd=ROOT / "src", check=True)
    for name in ("fcslam_pb2.py", "fcslam_pb2.pyi"):
        assert (tmp_path / "fcslam/wire" / name).read_bytes() == (ROOT / "src/fcslam/wire" / name).read_bytes()


def test_the_documents_name_every_field_and_limit():
    document = "".join(page.read_text(encoding="utf-8") for page in DOCUMENTS)
    missing = [field.name for field in FIELDS.values() if f"`{field.name}`" not in document]
    assert missing == []
    plain = re.sub(r"(?<=\d),(?=\d{3})", "", document)
    for number in (
        limits.MAXIMUM_PACKET_BYTES,
        limits.MAXIMUM_BEAMS,
        limits.MAXIMUM_KEYPOINTS,
        MOST_NETWORK_BYTES,
        MOST_POINTS,
    ):
        assert str(number) in plain
