"""Whatever the network does, the cloud gets every packet once, in order, and the robot its corrections."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.errors import CloudError, InputError, OversizeError, UnavailableError
from fcslam.robot.outbox import Outbox
from fcslam.robot.sender import ASK_AFTER_S, LONGEST_RETRY_S, SEND_INTERVAL_S, Sender, retry_delay_s
from fcslam.wire.http_transport import HttpResponse
from fcslam.wire.packets import encode
from tests.robot.fake_cloud import FakeCloud, Network, content, said
from tests.wire.examples import DETECTOR_UPDATE, HELLO, LIDAR_PLACE


class Robot:
    """An outbox and its sender, on a clock that only moves when the sender sleeps."""

    def __init__(self, path, network):
        self.now, self.network = 0.0, network
        self.corrections, self.kept, self.refused = [], [], []
        self.aside = self.refused.append
        self.outbox = Outbox(path, "alice", 10**9)
        self.known = self.outbox.begin("r", resume=path.with_name("resumed").exists())
        path.with_name("resumed").touch()
        self.sender = Sender(
            self.outbox, network, np.random.default_rng(0), lambda: self.now,
            lambda _, correction: self.corrections.append(correction),
            lambda file, content: self.kept.append((file, content)),
            lambda data, reason: self.aside((content(data), reason)),
        )  # fmt: skip

    def step(self):
        delay = self.sender.step()
        self.now += delay
        return delay


@pytest.fixture
def robot(tmp_path):
    robot = Robot(tmp_path / "outbox", Network(FakeCloud()))
    yield robot
    robot.outbox.close()


MOMENTS = st.one_of(
    st.integers(1, 5).map(lambda count: ("say", count)),
    st.sampled_from(Network.FAULTS).map(lambda fault: ("fault", fault)),
    st.just(("die", None)),
    st.just(("step", None)),
)


@pytest.mark.slow
@settings(max_examples=60)
@given(st.lists(MOMENTS, max_size=40), st.integers(1, 7), st.sets(st.integers(0, 40), max_size=5))
def test_every_packet_arrives_once_and_in_order(tmp_path_factory, moments, large, unwanted):
    """Requests and answers lost, cut, repeated or refused for now; the robot killed and resumed at any moment.

    Packets that the cloud refuses are set aside, even if its answer is lost.
    """
    network = Network(FakeCloud())
    path = tmp_path_factory.mktemp("robot") / "outbox"
    robot, packets, refused = Robot(path, network), [], []
    robot.aside = refused.append
    for what, argument in moments:
        if what == "say":
            numbers = range(len(packets), len(packets) + argument)
            new = [said(k, LIDAR_PLACE if k % large == 0 else HELLO, time=2000.0 + k) for k in numbers]
            network.cloud.unwanted |= {content(encode(packet)) for packet in new if packet.sequence in unwanted}
            robot.outbox.put(new)
            packets += new
        elif what == "fault":
            network.faults.append(argument)
        elif what == "die":
            robot.outbox.close()
            robot = Robot(path, network)
            robot.aside = refused.append
            assert robot.outbox.put(packets) == 0
        robot.step()
    for _ in range(2 * len(network.faults) + 2 * len(unwanted) + 3):
        robot.step()
    stored = network.cloud.stored
    contents = {(0, packet.sequence): content(encode(packet)) for packet in packets}
    wanted = {key: data for key, data in contents.items() if key[1] not in unwanted}
    assert list(stored) == list(wanted)
    assert [content(data) for data in stored.values()] == list(wanted.values())
    assert sorted(data for data, _ in refused) == sorted(network.cloud.unwanted)
    assert robot.outbox.waiting == (0, 0)
    robot.outbox.close()


def test_waiting_grows_to_a_bound_and_is_spread_over_all_of_it():
    rng = np.random.default_rng(1)
    for failures, bound in ((1, 1.0), (3, 4.0), (6, LONGEST_RETRY_S), (10**6, LONGEST_RETRY_S)):
        delays = np.array([retry_delay_s(failures, rng) for _ in range(2000)])
        assert 0.0 <= delays.min() < 0.05 * bound
        assert 0.95 * bound < delays.max() <= bound
        assert abs(delays.mean() - bound / 2.0) < 0.05 * bound


def test_a_cloud_that_asks_for_patience_gets_it(robot):
    robot.step()
    robot.outbox.put([said(0)])
    robot.network.faults.append("busy")
    assert 2.0 <= robot.step() <= 3.0


def test_what_collects_goes_together_and_what_is_too_much_goes_at_once(robot):
    large = [said(k, LIDAR_PLACE) for k in range(1500)]
    robot.outbox.put(large)
    assert robot.step() == 0.0, "more than a batch holds"
    assert robot.step() == SEND_INTERVAL_S
    assert robot.network.requests == 3, "the state, and two batches"


def test_a_robot_at_rest_asks_now_and_then_and_hears_of_corrections_once(robot):
    network = robot.network
    robot.outbox.put([said(0)])
    robot.step()
    network.cloud.correction = 3
    steps = [robot.step() for _ in range(4 * int(ASK_AFTER_S))]
    assert set(steps) == {SEND_INTERVAL_S}
    assert [correction.version for correction in robot.corrections] == [3]
    assert 4 <= network.requests - 2 <= 5
    network.cloud.correction = 2
    assert network.cloud.send((), -1).packets, "an older one, if it were asked for"
    for _ in range(10):
        robot.step()
    assert len(robot.corrections) == 1


def test_a_correction_of_an_earlier_start_is_about_another_odometry(tmp_path):
    network = Network(FakeCloud(correction=5))
    network.faults = ["request lost"]
    before = Robot(tmp_path / "outbox", network)
    before.outbox.put([said(0)])
    before.step()
    before.outbox.close()
    (tmp_path / "resumed").unlink()
    anew = Robot(tmp_path / "outbox", network)
    anew.outbox.put([said(0)])
    anew.step()
    assert list(network.cloud.stored) == [(0, 0)]
    assert anew.corrections == []
    anew.step()
    assert list(network.cloud.stored) == [(0, 0), (1, 0)]
    assert [correction.version for correction in anew.corrections] == [5]
    anew.outbox.close()


def test_a_refused_packet_stays_until_it_is_kept_elsewhere(robot):
    def no_room(*_):
        raise InputError("no room")

    robot.aside = no_room
    robot.network.cloud.unwanted = {content(encode(said(1)))}
    robot.outbox.put([said(0, HELLO), said(1)])
    with pytest.raises(InputError, match="no room"):
        robot.step()
    assert robot.outbox.waiting.packets == 1
    assert content(robot.outbox.packet(0, 1)) == content(encode(said(1)))


def test_a_robot_says_that_it_is_removed_and_no_longer_when_it_is_back(robot):
    robot.outbox.put([said(k) for k in range(2)])
    for removed in (False, True, False):
        robot.network.cloud.removed = removed
        robot.now += 10.0
        robot.sender.step()
        assert bool(robot.sender.notices) == removed


def test_what_the_cloud_refuses_after_it_confirmed_it_is_told(robot):
    network = robot.network
    robot.outbox.put([said(k) for k in range(3)])
    robot.step()
    assert not robot.sender.notices
    network.cloud.refused[0, 1] = "no such keyscan"
    robot.outbox.put([said(3)])
    before = network.requests
    robot.step()
    assert "packet 1 of start 0: no such keyscan" in " ".join(robot.sender.notices)
    assert network.requests == before + 2, "the batch, and what became of the packets"
    robot.outbox.put([said(4)])
    robot.step()
    assert network.requests == before + 3, "what is known is not asked for again"
    assert robot.refused == []


@pytest.mark.parametrize("most", [1, 3, 7])
def test_a_batch_that_is_too_large_is_sent_in_parts(robot, most):
    network = robot.network
    network.cloud.most = most
    robot.outbox.put([said(k, LIDAR_PLACE) for k in range(20)])
    for _ in range(30):
        robot.step()
    assert list(network.cloud.stored) == [(0, k) for k in range(20)]
    assert robot.outbox.waiting == (0, 0)


def test_a_single_packet_that_is_too_large_is_told(robot):
    robot.network.cloud.most = 0
    robot.outbox.put([said(0)])
    with pytest.raises(OversizeError):
        robot.step()
    assert robot.outbox.waiting.packets == 1


def test_a_cloud_that_confirms_nothing_is_not_asked_in_a_hurry(robot):
    robot.network.send = lambda *_: HttpResponse()
    robot.outbox.put([said(0)])
    delays = [robot.step() for _ in range(8)]
    assert "confirms no packet" in robot.sender.trouble
    assert sum(delays) > 2.0
    assert robot.outbox.waiting.packets == 1


def test_a_cloud_that_opens_another_mission_is_found_out_and_gets_the_next_start(tmp_path):
    network = Network(FakeCloud())
    before = Robot(tmp_path / "outbox", network)
    before.outbox.put([said(0), said(1)])
    before.step()
    network.cloud = FakeCloud()
    before.outbox.put([said(2), said(3)])
    before.step()
    with pytest.raises(InputError, match="its mission is another one; start anew: without --resume"):
        before.step()
    before.outbox.close()
    (tmp_path / "resumed").unlink()
    anew = Robot(tmp_path / "outbox", network)
    anew.outbox.put([said(0, HELLO), said(1)])
    anew.step()
    assert list(network.cloud.stored) == [(0, 2), (0, 3), (1, 0), (1, 1)], "it was sent before it was found out"
    assert [data for data, _ in anew.refused] == [content(encode(said(k))) for k in (2, 3)]
    assert "another mission" in anew.refused[0][1]
    assert "2 packets of earlier starts belong to another mission" in anew.sender.notices[0]
    assert (anew.sender.confirmed, anew.sender.refusals) == (2, 2)
    assert anew.outbox.waiting == (0, 0)
    anew.outbox.close()


def test_another_mission_is_found_out_though_the_cloud_takes_nothing(robot):
    """It asks for what comes first, which this robot sent to the mission before."""

    def far_behind(*_):
        raise UnavailableError("packet 2 is far ahead; send packet 0 first")

    robot.outbox.put([said(0), said(1)])
    robot.step()
    robot.network.cloud, robot.network.send = FakeCloud(), far_behind
    robot.outbox.put([said(2)])
    robot.step()
    assert "far ahead" in robot.sender.trouble
    with pytest.raises(InputError, match="its mission is another one"):
        robot.step()


def test_a_robot_that_has_sent_everything_says_that_it_ends(tmp_path):
    cloud, stopped = FakeCloud(), threading.Event()
    robot = Robot(tmp_path / "outbox", Network(cloud))
    stopped.set()
    robot.outbox.put([said(0), said(1)])
    robot.sender.run(stopped)
    assert not cloud.has_ended, "packets wait"
    while robot.outbox.waiting.packets:
        robot.step()
    robot.sender.run(stopped)
    assert cloud.has_ended
    robot.outbox.close()


def test_a_cloud_that_turns_the_robot_away_ends_the_sender(robot):
    def turned_away():
        raise CloudError("no token")

    robot.network.state = turned_away
    robot.outbox.put([said(0)])
    robot.sender.run(threading.Event())
    assert str(robot.sender.failure) == "no token"
    assert robot.outbox.waiting.packets == 1


def test_a_detector_is_fetched_once_and_one_that_is_not_there_not_asked_for_again(robot):
    cloud = robot.network.cloud
    missing = replace(DETECTOR_UPDATE.file, version="gone")
    cloud.detector_updates = {DETECTOR_UPDATE.file: b"network", missing: None}
    for ordinal in range(5):
        robot.outbox.put([said(ordinal)])
        robot.step()
    assert robot.kept == [(DETECTOR_UPDATE.file, b"network")]
    assert cloud.fetched == [DETECTOR_UPDATE.file.version, "gone"]
    assert robot.outbox.waiting.packets == 0
