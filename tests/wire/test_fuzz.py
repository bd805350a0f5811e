"""Whatever arrives is a valid packet or a PacketError."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.errors import PacketError
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.limits import VERSION
from fcslam.wire.packets import decode, encode, read_label
from tests.wire.examples import EXAMPLES, same

VALID = [encode(example) for example in EXAMPLES.values()]


def packet_or_reason(data):
    try:
        return decode(data)
    except PacketError as error:
        return str(error)


def receive(data):
    """Values that were read are valid: sent on, they stay the same."""
    result = packet_or_reason(data)
    if isinstance(result, str):
        assert 0 < len(result) < 400
    else:
        assert same(decode(encode(result)), result)
        assert read_label(data).robot == result.robot


@given(st.binary(max_size=300))
def test_random_bytes(data):
    receive(data)


@pytest.mark.slow
@settings(max_examples=500)
@given(
    st.sampled_from(VALID),
    st.lists(st.tuples(st.integers(0, 200), st.integers(0, 2), st.binary(min_size=1, max_size=3)), max_size=4),
)
def test_mutated_packets(data, edits):
    for position, removed, inserted in edits:
        at = position % len(data)
        data = data[:at] + inserted + data[at + removed :]
    receive(data)


@given(st.sampled_from(VALID), st.data())
def test_spliced_packets(data, more):
    other = more.draw(st.sampled_from(VALID))
    receive(data[: more.draw(st.integers(0, len(data)))] + other[more.draw(st.integers(0, len(other))) :])


@pytest.mark.slow
def test_every_flip_of_one_bit():
    for data in VALID:
        for bit in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            receive(bytes(flipped))


@st.composite
def messages(draw, descriptor):
    """Any content of a message that protobuf itself allows."""
    fields = {}
    for field in descriptor.fields:
        if field.containing_oneof or draw(st.integers(0, 9)) == 0:
            continue
        value = values(field)
        fields[field.name] = draw(st.lists(value, max_size=8) if field.is_repeated else value)
    for oneof in descriptor.oneofs:
        chosen = draw(st.sampled_from(list(oneof.fields)))
        fields[chosen.name] = draw(messages(chosen.message_type))
    return getattr(pb, descriptor.name)(**fields)


def values(field):
    if field.message_type:
        return messages(field.message_type)
    return {
        field.TYPE_DOUBLE: st.floats() | st.floats(-3.0, 3.0),
        field.TYPE_FLOAT: st.floats(width=32) | st.floats(0.5, 1.5, width=32),
        field.TYPE_UINT32: st.integers(0, 3) | st.integers(0, 2**32 - 1),
        field.TYPE_SINT32: st.integers(-3, 3) | st.integers(-(2**31), 2**31 - 1),
        field.TYPE_UINT64: st.integers(0, 3) | st.integers(0, 2**64 - 1),
        field.TYPE_ENUM: st.integers(0, 2) | st.integers(-(2**31), 2**31 - 1),
        field.TYPE_STRING: st.sampled_from(["alice", "orb-1"]) | st.text(max_size=70),
        field.TYPE_BYTES: st.sampled_from([b"", bytes(4), bytes(32), b"\x63\x60\x00\x00"]) | st.binary(max_size=70),
    }[field.type]


@pytest.mark.slow
@settings(max_examples=300)
@given(messages(pb.Packet.DESCRIPTOR), st.booleans())
def test_any_protobuf_message(message, known_version):
    message.version = VERSION if known_version else message.version
    receive(message.SerializeToString())
