"""The in-memory transport: bytes both ways, refusals as values, a ledger that adds up."""

import pytest

from fcslam.errors import PacketError
from fcslam.records import Channel
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.ledger import Counter, Ledger, Traffic
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import Label, decode, encode
from fcslam.wire.transport import InMemoryTransport, Reply, Transport
from tests.wire.examples import ACKNOWLEDGEMENT, CORRECTION, EXAMPLES, packet, same

DOWNLINK = (encode(packet(ACKNOWLEDGEMENT)), encode(packet(CORRECTION)))


class Cloud:
    def __init__(self):
        self.received = []

    def receive(self, data):
        self.received.append(decode(data))
        return DOWNLINK


def test_bytes_arrive_and_answers_come_back():
    cloud = Cloud()
    transport: Transport = InMemoryTransport(cloud.receive)
    for example in EXAMPLES.values():
        assert transport.send(encode(example)) == Reply(DOWNLINK)
    assert all(same(received, sent) for received, sent in zip(cloud.received, EXAMPLES.values(), strict=True))


def test_the_ledger_adds_up():
    transport = InMemoryTransport(Cloud().receive)
    keyscan, closure = encode(EXAMPLES["keyscan"]), encode(EXAMPLES["closure"])
    for data in (keyscan, closure, keyscan):
        transport.send(data)
    ledger = transport.ledger()
    assert dict(ledger.accepted) == {
        Label("alice", PacketKind.KEYSCAN): Traffic(2, 2 * len(keyscan)),
        Label("alice", PacketKind.CONSTRAINT): Traffic(1, len(closure)),
        Label("alice", PacketKind.ACKNOWLEDGEMENT): Traffic(3, 3 * len(DOWNLINK[0])),
        Label("alice", PacketKind.CORRECTION): Traffic(3, 3 * len(DOWNLINK[1])),
    }
    assert ledger.total() == Traffic(9, 2 * len(keyscan) + len(closure) + 3 * sum(map(len, DOWNLINK)))
    assert (
        ledger.total("alice", PacketKind.KEYSCAN)
        == ledger.total(kind=PacketKind.KEYSCAN)
        == Traffic(2, 2 * len(keyscan))
    )
    assert ledger.total("bob") == Traffic()
    assert ledger.refused == Traffic()


def test_places_are_counted_by_channel_and_what_goes_up_by_robot():
    transport = InMemoryTransport(Cloud().receive)
    lidar, camera, hello = (encode(EXAMPLES[name]) for name in ("lidar_place", "camera_place", "hello"))
    for data in (lidar, camera, hello, camera):
        transport.send(data)
    ledger = transport.ledger()
    assert ledger.total(channel=Channel.LIDAR) == Traffic(1, len(lidar))
    assert ledger.total(channel=Channel.CAMERA) == Traffic(2, 2 * len(camera))
    assert ledger.total(kind=PacketKind.PLACE) == Traffic(3, len(lidar) + 2 * len(camera))
    assert ledger.uplink("alice") == Traffic(4, len(lidar) + 2 * len(camera) + len(hello)), "not what comes back"
    assert ledger.downlink("alice") == Traffic(8, 4 * sum(map(len, DOWNLINK)))
    assert ledger.uplink("alice") + ledger.downlink("alice") == ledger.total("alice")
    assert ledger.uplink("bob") == ledger.downlink("bob") == Traffic()


def test_a_place_of_an_unknown_channel_is_refused():
    place = pb.Packet(version=2, robot="bob", place=pb.Place(channel=7)).SerializeToString()
    assert InMemoryTransport(Cloud().receive).send(place) == Reply(refusal="channel 7 is unknown")


def test_a_ledger_shown_does_not_change():
    transport = InMemoryTransport(lambda _: ())
    before = transport.ledger()
    transport.send(encode(EXAMPLES["hello"]))
    assert before.total() == Traffic()
    with pytest.raises(TypeError):
        before.accepted[Label("eve", PacketKind.HELLO)] = Traffic()


@pytest.mark.parametrize("data", [b"", b"noise", encode(EXAMPLES["keyscan"])[:-1], bytes(200_000)])
def test_broken_bytes_are_refused_with_a_reason(data):
    cloud = Cloud()
    transport = InMemoryTransport(cloud.receive)
    reply = transport.send(data)
    assert reply.refusal
    assert reply.packets == ()
    assert cloud.received == []
    assert transport.ledger() == Ledger({}, Traffic(1, len(data)))


def test_what_the_handler_refuses_is_refused_and_not_counted_as_accepted():
    def handler(data):
        raise PacketError("robot alice is unknown")

    transport = InMemoryTransport(handler)
    data = encode(EXAMPLES["hello"])
    assert transport.send(data) == Reply(refusal="robot alice is unknown")
    assert transport.ledger() == Ledger({}, Traffic(1, len(data)))


def test_a_fault_of_the_handler_is_no_refusal():
    def handler(data):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        InMemoryTransport(handler).send(encode(EXAMPLES["hello"]))


def test_a_broken_answer_is_a_fault_and_no_refusal():
    transport = InMemoryTransport(lambda _: [b"noise"])
    with pytest.raises(PacketError):
        transport.send(encode(EXAMPLES["hello"]))


def test_counting_is_addition():
    counter = Counter()
    for size in (3, 4, 5):
        counter.accept(Label("bob", PacketKind.PLACE), size)
    assert counter.ledger().total() == Traffic(3, 12)
