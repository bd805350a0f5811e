"""The ledger counts packets and bytes by robot, kind and channel, and a measured packet is the one that its receiver
reads.
"""

from hypothesis import given

from fcslam.records import Channel
from fcslam.wire.ledger import Ledger, Traffic
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import Label, decode, encode, measure, read_label
from tests.wire.examples import EXAMPLES, same
from tests.wire.strategies import packets


def counted(*names):
    ledger = Ledger()
    for name in names:
        ledger.accept(*label_and_size(name))
    return ledger


def label_and_size(name):
    sized = measure(EXAMPLES[name])
    return sized.label, len(sized.data)


def size(name):
    return len(encode(EXAMPLES[name]))


@given(packets())
def test_a_measured_packet_is_the_decoded_one(packet):
    data, sized = encode(packet), measure(packet)
    assert sized.data == data
    assert same(sized.packet, decode(data))
    assert sized.label == read_label(data)


def test_the_ledger_adds_up():
    ledger = counted("keyscan", "closure", "keyscan", "acknowledgement")
    assert ledger.accepted == {
        Label("alice", PacketKind.KEYSCAN): Traffic(2, 2 * size("keyscan")),
        Label("alice", PacketKind.CONSTRAINT): Traffic(1, size("closure")),
        Label("alice", PacketKind.ACKNOWLEDGEMENT): Traffic(1, size("acknowledgement")),
    }
    assert ledger.total() == Traffic(4, 2 * size("keyscan") + size("closure") + size("acknowledgement"))
    assert ledger.total("alice", PacketKind.KEYSCAN) == ledger.total(kind=PacketKind.KEYSCAN)
    assert ledger.total("bob") == Traffic()


def test_places_are_counted_by_channel_and_what_goes_up_by_robot():
    names = ("lidar_place", "camera_place", "hello", "camera_place")
    ledger = counted(*names, "acknowledgement", "correction")
    assert ledger.total(channel=Channel.LIDAR) == Traffic(1, size("lidar_place"))
    assert ledger.total(channel=Channel.CAMERA) == Traffic(2, 2 * size("camera_place"))
    assert ledger.uplink("alice") == Traffic(4, sum(map(size, names))), "not what comes back"
    assert ledger.downlink("alice") == Traffic(2, size("acknowledgement") + size("correction"))
    assert ledger.uplink("alice") + ledger.downlink("alice") == ledger.total("alice")
    assert ledger.uplink("bob") == ledger.downlink("bob") == Traffic()
