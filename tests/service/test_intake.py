"""Batches: stored before they are acknowledged, refused with a reason, one agent at a time."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.cloud.claims import ClaimLimits
from fcslam.cloud.replies import SessionCorrection
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import InputError, PacketConflictError, PacketError, UnavailableError
from fcslam.geometry import se3
from fcslam.mission.mission_store import MissionStore
from fcslam.records import Correction, frozen
from fcslam.service.intake import AGENT_LEASE_S, PACKET_BYTES, Intake, PlaneError
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.batches import read_batch, write_batch
from fcslam.wire.limits import MAXIMUM_BATCH_PACKETS, MAXIMUM_PACKET_BYTES, VERSION
from fcslam.wire.messages import Acknowledgement, Hello, Packet
from fcslam.wire.packets import decode, encode
from tests.scripted import rectangle, stream
from tests.wire.examples import CLOSURE

PACKETS = stream("a", rectangle(9), start_s=0.0)
DATA = [encode(packet) for packet in PACKETS]


class Desk:
    """An intake over a store, with a clock that stands still."""

    def __init__(self, path):
        self.now = 100.0
        self.store = MissionStore(path)
        self.intake = Intake(self.store, lambda: self.now, lambda: 1e9)

    def take(self, *data, robot="a", agent="x", known=-1):
        batch, _, _ = self.intake.take(robot, agent, write_batch(data), known)
        return [decode(packet).body for packet in read_batch(batch)]


@pytest.fixture
def desk(tmp_path):
    desk = Desk(tmp_path / "mission.sqlite")
    yield desk
    desk.store.close()


def test_poses_in_space_are_stored_by_a_mission_in_space_alone(desk):
    motion = replace(CLOSURE, robot="a", T_i_j=se3.from_plane(CLOSURE.T_i_j), information=np.eye(6))
    in_space = encode(replace(PACKETS[0], sequence=1000, body=motion))
    with pytest.raises(PlaneError, match="a: sends poses in space, and this mission began in the plane"):
        desk.take(*DATA, in_space)
    assert desk.store.arrivals(0, 10) == []
    small(desk, fleet=FleetConfig(dimensions=3))
    desk.take(*DATA, in_space)
    assert len(desk.store.arrivals(0, 1000)) == len(DATA) + 1


@pytest.mark.slow
@given(data=st.data())
def test_what_is_acknowledged_is_stored_without_a_gap(data, tmp_path_factory):
    desk = Desk(tmp_path_factory.mktemp("intake") / "mission.sqlite")
    sent = set()
    for _ in range(data.draw(st.integers(1, 5))):
        numbers = data.draw(st.lists(st.integers(0, len(DATA) - 1), max_size=10))
        answer = desk.take(*(DATA[k] for k in numbers))
        sent |= set(numbers)
        missing = next(n for n in range(len(DATA) + 1) if n not in sent)
        expected = [Acknowledgement("a", 0, missing - 1)] if missing else []
        assert answer == expected
        assert desk.intake.ready_count() == missing
        assert desk.intake.ready_count() + desk.intake.waiting_count() == len(sent)
        assert {p.data for _, p in desk.store.arrivals(0, 100)} == {DATA[k] for k in sent}
    desk.store.close()


def test_a_restarted_intake_acknowledges_the_same(desk):
    desk.take(*DATA[:3], DATA[5])
    desk.intake = Intake(desk.store, lambda: desk.now, lambda: 1e9)
    assert desk.take() == [Acknowledgement("a", 0, 2)]
    assert desk.intake.waiting_count("a") == 1
    assert desk.take(*DATA[3:5]) == [Acknowledgement("a", 0, 5)]


def test_a_conflict_in_a_batch_leaves_the_packets_before_it_acknowledged(desk):
    desk.take(*DATA[:2])
    with pytest.raises(PacketConflictError):
        desk.take(DATA[2], encode(replace(PACKETS[3], sequence=1)))
    assert desk.take() == [Acknowledgement("a", 0, 2)]


def test_every_epoch_in_a_batch_is_acknowledged(desk):
    later = replace(PACKETS[0], epoch=4, body=replace(PACKETS[0].body, epoch=4))
    told = desk.take(DATA[0], encode(later))
    assert told == [Acknowledgement("a", 0, 0), Acknowledgement("a", 4, 0)]
    assert desk.take() == [Acknowledgement("a", 4, 0)], "a robot that only asks hears of its newest session"


def claiming(**claims):
    return FleetConfig(claims=ClaimLimits(**claims))


def small(desk, **limits):
    desk.intake = Intake(desk.store, lambda: desk.now, lambda: 1e9, **limits)


def test_of_many_sessions_the_later_ones_wait(desk):
    small(desk, fleet=claiming(sessions_per_hour=3))
    hellos = [
        encode(replace(PACKETS[0], epoch=epoch, body=replace(PACKETS[0].body, epoch=epoch))) for epoch in range(5)
    ]
    for hello in hellos[:3]:
        desk.take(hello)
    with pytest.raises(UnavailableError, match=r"3 sessions per hour.*1200 s") as busy:
        desk.take(hellos[3])
    assert busy.value.retry_after_s == pytest.approx(1200.0)
    desk.take(*DATA[:3])
    assert [session.epoch for session in desk.intake.sessions("a")] == [0, 1, 2], "nothing of it is stored"
    desk.now += 1201.0
    desk.take(hellos[3])
    with pytest.raises(UnavailableError):
        desk.take(hellos[4])


def test_a_session_that_has_to_be_sent_again_for_lack_of_room_counts_once(desk):
    small(desk, fleet=claiming(sessions_per_hour=2), most_waiting=3)
    desk.take(*DATA[:5])
    later = encode(replace(PACKETS[0], epoch=1, body=replace(PACKETS[0].body, epoch=1)))
    for _ in range(3):
        with pytest.raises(UnavailableError, match="5 packets have not taken effect yet"):
            desk.take(later)
    desk.store.progress(5, [])
    assert desk.take(later) == [Acknowledgement("a", 1, 0)]


def test_of_many_packets_the_later_ones_wait(desk):
    small(desk, fleet=claiming(packets_per_s=0.2))
    most = MAXIMUM_BATCH_PACKETS * MAXIMUM_PACKET_BYTES // PACKET_BYTES
    for _ in range(most // len(DATA)):
        desk.take(*DATA)  # a packet that comes again counts again
    left = most % len(DATA)
    with pytest.raises(UnavailableError, match=r"0\.2 packets of 8192 bytes per second") as busy:
        desk.take(*DATA[: left + 1])
    assert busy.value.retry_after_s == pytest.approx(5.0)
    desk.now += 5.0
    assert desk.take(*DATA[: left + 1]) == [Acknowledgement("a", 0, len(DATA) - 1)]
    desk.take(robot="b")


def test_what_unpacks_to_much_counts_for_that_before_it_is_unpacked(desk):
    """Places that announce 2,048 keypoints in a few bytes: about 80 kB each."""
    body = {"number": 0, "channel": 1, "count": 2048, "detector_version": "test-1"}
    packets = [pb.Packet(version=VERSION, robot="a", sequence=k, place=body).SerializeToString() for k in range(1000)]
    assert sum(map(len, packets)) < 50_000
    small(desk, fleet=claiming(packets_per_s=1.0))
    with pytest.raises(PacketError):
        desk.take(*packets)
    with pytest.raises(UnavailableError, match="packets of"):
        desk.take(*packets[500:])


def test_a_correction_is_told_once(desk):
    desk.take(*DATA[:5])
    pose = frozen(np.array([1.0, 2.0, 0.5]))
    desk.store.progress(5, [SessionCorrection("a", 0, 3.0, Correction("a", 0, 2, pose))])
    first = desk.take(DATA[5])[-1]
    assert (first.map_index, first.T_map_odom.tolist()) == (2, pose.tolist())
    assert desk.take(DATA[6], known=first.version) == [Acknowledgement("a", 0, 6)]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (b"\x00\x01\x02", "protobuf"),
        (DATA[3][:-1], "protobuf"),
        (encode(stream("b", rectangle(9), 0.0)[3]), "robot b, sent by a"),
        (encode(Packet("a", 0, 3, 0.0, Acknowledgement("a", 0, 3))), "goes to a robot"),
        (DATA[3] + b"\xc0\x3e\x01", "unknown"),
    ],
)
def test_a_bad_packet_is_refused_and_those_before_it_are_stored(desk, bad, reason):
    for _ in range(2):  # a second attempt fares no better
        with pytest.raises(PacketError, match=reason) as caught:
            desk.take(*DATA[:3], bad, *DATA[4:6])
        assert caught.value.index == 3
    assert [p.data for _, p in desk.store.arrivals(0, 100) if p.refusal is None] == DATA[:3]


def test_the_number_of_a_refused_packet_is_used_up_so_the_next_ones_are_acknowledged(desk):
    with pytest.raises(PacketError):
        desk.take(*DATA[:3], DATA[3] + b"\xc0\x3e\x01")
    assert desk.take(DATA[4]) == [Acknowledgement("a", 0, 4)]
    assert [(number, bool(reason)) for _, number, reason in desk.store.refusals("a")] == [(3, True)]


def test_bytes_that_are_no_batch_change_nothing(desk):
    with pytest.raises(PacketError, match="batch"):
        desk.intake.take("a", "x", write_batch(DATA[:2])[:-1], -1)
    assert desk.store.envelopes() == []


def test_a_second_agent_waits_until_the_first_is_silent_long_enough(desk):
    desk.take(DATA[0], agent="x")
    desk.take(robot="b", agent="y")  # another robot is another matter
    with pytest.raises(InputError, match="another process"):
        desk.take(DATA[1], agent="y")
    desk.now += AGENT_LEASE_S - 1.0
    desk.take(DATA[1], agent="x")
    desk.now += AGENT_LEASE_S - 1.0
    with pytest.raises(InputError):
        desk.take(DATA[2], agent="y")
    desk.now += 1.0
    assert desk.take(DATA[2], agent="y") == [Acknowledgement("a", 0, 2)]
    with pytest.raises(InputError):
        desk.take(DATA[3], agent="x")


def other_robot(count):
    return [encode(packet) for packet in stream("b", rectangle(9), start_s=0.0)][:count]


@pytest.mark.parametrize(("applied", "queued"), [(0, {}), (1, {"a": 4}), (1, {"b": 1, "a": 4})])
def test_of_a_robot_whose_packets_wait_for_the_worker_no_more_are_taken(desk, applied, queued):
    """Whether the worker has read them, or not yet."""
    small(desk, most_waiting=3)
    desk.take(*other_robot(1), robot="b")
    desk.take(*DATA[:5])
    desk.store.progress(applied, [], queued)
    with pytest.raises(UnavailableError, match=f"{5 - len(queued) // 2} packets have not taken effect yet"):
        desk.take(DATA[5])
    assert desk.take(*other_robot(4), robot="b") == [Acknowledgement("b", 0, 3)], "another robot does not wait"
    assert desk.take() == [Acknowledgement("a", 0, 4)], "and it may ask"
    desk.store.progress(3, [], {"b": 1, "a": 1})
    assert desk.take(DATA[5]) == [Acknowledgement("a", 0, 5)]


def test_packets_that_another_request_stored_and_the_worker_applied_meanwhile_disturb_nobody(desk):
    desk.take(*DATA[:3])
    desk.store.progress(9, [])  # six more came between this request's look at the store and the worker's count
    assert desk.take(DATA[3]) == [Acknowledgement("a", 0, 3)]


def test_a_wall_clock_that_steps_changes_neither_answers_nor_the_order(desk, tmp_path):
    store, steps_s = MissionStore(tmp_path / "other.sqlite"), iter((1e9, 0.0, 2e9, -1e9))
    stepping = Intake(store, lambda: 100.0, lambda: next(steps_s))
    for first in range(0, 8, 2):
        batch = write_batch(DATA[first : first + 2])
        assert stepping.take("a", "x", batch, -1) == desk.intake.take("a", "x", batch, -1)
    assert [one.data for _, one in store.arrivals(0, 100)] == [one.data for _, one in desk.store.arrivals(0, 100)]
    store.close()


def test_packets_that_wait_for_one_before_them_keep_out_neither_it_nor_other_robots(desk):
    small(desk, most_waiting=6)
    in_epoch = [encode(replace(p, epoch=1)) for p in PACKETS[1:9] if not isinstance(p.body, Hello)]
    desk.take(*DATA[1:5])
    desk.take(*in_epoch[:2])
    for data in (DATA[5:6], in_epoch[2:3]):
        with pytest.raises(UnavailableError, match="send packet 0 of epoch"):
            desk.take(*data)
    assert desk.take(*other_robot(5), robot="b") == [Acknowledgement("b", 0, 4)]
    assert desk.take(DATA[0])[0] == Acknowledgement("a", 0, 4)
    assert desk.take(DATA[5])[0] == Acknowledgement("a", 0, 5)


def test_of_a_robot_with_too_many_refused_packets_no_more_are_stored_and_a_line_comes_before(desk, caplog):
    small(desk, most_refused_bytes=3 * PACKET_BYTES)
    for number in range(1, 4):
        with pytest.raises(PacketError):
            desk.take(DATA[number] + b"\xc0\x3e\x01")
        assert len(caplog.records) == (number == 3)
    with pytest.raises(UnavailableError, match="3 packets were refused"):
        desk.take(DATA[0])
    (line,) = caplog.records
    assert "a: 2 packets were refused" in line.getMessage()
    assert len(desk.store.envelopes()) == 3
    assert desk.take(*other_robot(2), robot="b") == [Acknowledgement("b", 0, 1)]
    assert desk.take() == [], "it may ask"
