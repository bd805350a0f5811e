"""A batch gives back the packets that were put in, or a reason."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.errors import PacketError
from fcslam.wire.batches import read_batch, write_batch
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS, MAXIMUM_PACKET_BYTES
from tests.wire.examples import GOLDEN

PACKETS = [path.read_bytes() for path in sorted(GOLDEN.iterdir())]


def lengths_first(packets):
    """The format once more, by other means."""
    return b"".join(len(packet).to_bytes(4, "big") + packet for packet in packets)


def batch_or_reason(data):
    try:
        return read_batch(data)
    except PacketError as error:
        return str(error)


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=20))
def test_what_goes_in_comes_out(packets):
    data = write_batch(packets)
    assert data == lengths_first(packets)
    assert read_batch(data) == packets


@given(st.binary(max_size=60) | st.lists(st.integers(0, 9)).map(bytes))
def test_any_bytes_are_the_batch_of_what_is_read_or_refused(data):
    result = batch_or_reason(data)
    assert result.startswith("batch: ") if isinstance(result, str) else write_batch(result) == data


@given(st.data())
def test_a_cut_or_changed_batch_is_another_batch_or_refused(draw):
    data = write_batch(PACKETS)
    at = draw.draw(st.integers(0, len(data) - 1))
    ends = {len(lengths_first(PACKETS[:count])) for count in range(len(PACKETS))}
    if at in ends:
        assert read_batch(data[:at]) == PACKETS[: sorted(ends).index(at)]
    else:
        with pytest.raises(PacketError, match="it ends within"):
            read_batch(data[:at])
    changed = bytearray(data)
    changed[at] ^= draw.draw(st.integers(1, 255))
    assert batch_or_reason(bytes(changed)) != PACKETS


@pytest.mark.parametrize("write", [write_batch, lambda packets: read_batch(lengths_first(packets))])
@pytest.mark.parametrize(
    ("packets", "reason"),
    [
        ([b""], "packet 0 has 0 bytes"),
        ([b"x", bytes(MAXIMUM_PACKET_BYTES + 1)], f"packet 1 has {MAXIMUM_PACKET_BYTES + 1} bytes"),
        ([b"x"] * (MAXIMUM_BATCH_PACKETS + 1), f"over {MAXIMUM_BATCH_PACKETS} packets"),
        ([bytes(MAXIMUM_PACKET_BYTES)] * 11, f"{11 * (MAXIMUM_PACKET_BYTES + 4)} bytes, at most"),
    ],
)
def test_limits_hold_on_both_sides(write, packets, reason):
    with pytest.raises(PacketError, match=reason):
        write(packets)


def test_the_limits_themselves_are_allowed():
    many = [b"x"] * MAXIMUM_BATCH_PACKETS
    large = [bytes(MAXIMUM_PACKET_BYTES)] * 10
    large.append(bytes(MAXIMUM_BATCH_BYTES - len(lengths_first(large)) - 4))
    assert len(write_batch(large)) == MAXIMUM_BATCH_BYTES
    assert read_batch(write_batch(many)) == many
    assert read_batch(write_batch(large)) == large
