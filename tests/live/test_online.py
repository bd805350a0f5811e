"""A robot maps the same whether its cloud is there, slow, or away, and comes back where it was."""

import threading
from contextlib import closing
from itertools import chain

import numpy as np
import pytest

from fcslam.cli.play import PlaybackPace, play_records
from fcslam.errors import CloudError, InputError
from fcslam.features.detector_file import describe_detector_file
from fcslam.geometry import se2
from fcslam.live.records import EventKind, LocalizationState, Wiring
from fcslam.live.robot import Robot
from fcslam.maps.occupancy_map import Occupancy
from fcslam.mission.driving import front_end_of
from fcslam.records import Channel, CloudScan, LaserScan, Place
from fcslam.robot.frontend import RobotConfig
from fcslam.robot.outbox import Outbox
from fcslam.wire.keys import Server
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.features.networks import tiny_network
from tests.live.same_thread import SameThread
from tests.robot.fake_cloud import FakeCloud, Network, content
from tests.robot.kidnapping import kidnapping
from tests.spinning_lidar import circle, room
from tests.spinning_lidar import drive as drive_lidar
from tests.wire.examples import CORRECTION

pytestmark = pytest.mark.slow

AS_FAST_AS_POSSIBLE = PlaybackPace(None, lambda: 0.0, lambda _: None)


def test_a_server_hides_its_token_and_has_a_budget_above_zero():
    assert "secret" not in repr(Server("https://cloud", "secret"))
    for budget_kBps in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="above 0"):
            Server("https://cloud", budget_kBps=budget_kBps)


@pytest.fixture(scope="module", params=["2D"])
def scans(request):
    if request.param == "3D":
        return [scan for scan, _ in drive_lidar(room(1), circle((6.0, 4.0), 1.6, 0.8), 80, azimuths=120)]
    return list(small_fleet.draw(1, path_length_m=12.0).robots[0].scans())


both_lidars = pytest.mark.parametrize("scans", ["2D", "3D"], indirect=True)


@pytest.fixture(scope="module")
def alone(scans):
    """Results of the front end without any network."""
    frontend = front_end_of("alice", RobotConfig(), scans[:1])
    return [packet for scan in scans for packet in frontend.process(scan)] + frontend.finish()


class Clock:
    """Each look at it takes a second; what sleeps, sleeps for no time."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 1.0
        return self.now


def drive(tmp_path, network, records, resume=False, watch=lambda _: None, recording="r"):
    pause, records = threading.Event(), iter(records)
    first = next(records)
    in_space = isinstance(first, CloudScan)
    robot = Robot(
        "alice", state=tmp_path, own_map=False, lidar_3d=in_space, config={"fleet": {"dimensions": 2 + in_space}},
        wiring=Wiring(
            SameThread(), Clock(), lambda _: pause.wait(0.001), recording, resume, transport=network
        ),
    )  # fmt: skip
    with closing(robot):
        play_records(robot, chain([first], records), AS_FAST_AS_POSSIBLE, watch)
        return robot


def stop_after(records, count):
    for number, record in enumerate(records):
        if number == count:
            raise KeyboardInterrupt
        yield record


def contents(packets):
    return [encode(packet) for packet in packets]


@both_lidars
def test_the_cloud_gets_what_the_front_end_says(scans, alone, tmp_path):
    cloud = FakeCloud(correction=CORRECTION.version)
    robot = drive(tmp_path, Network(cloud), scans)
    assert [content(data) for data in cloud.stored.values()] == [content(data) for data in contents(alone)]
    assert list(cloud.stored) == [(0, k) for k in range(len(alone))]
    now = robot.status()
    assert (now.scans, now.waiting.packets, now.confirmed, now.trouble) == (len(scans), 0, len(alone), None)
    assert (now.map_index, now.left_out, now.refused, now.is_catching_up) == (CORRECTION.map_index, 0, 0, False)
    assert now.sent_bytes == sum(map(len, cloud.stored.values()))
    path = robot.trajectory()
    assert np.array_equal(path.stamps, [scan.stamp for scan in scans])
    assert np.allclose(se2.between(CORRECTION.T_map_odom, path.T_map_base[0]), 0.0, atol=1e-9)
    assert path.poses.shape == (len(scans), 3 if isinstance(scans[0], LaserScan) else 7)


@both_lidars
@pytest.mark.parametrize("stop", [1, 40])
def test_a_robot_that_was_stopped_goes_on_in_the_same_epoch(scans, alone, tmp_path, stop):
    cloud = FakeCloud()
    with pytest.raises(KeyboardInterrupt):
        drive(tmp_path, Network(cloud, ["request lost"] * 2), stop_after(scans, stop))
    seen = []
    drive(
        tmp_path, Network(cloud, ["answer lost"]), scans, resume=True, watch=lambda now: seen.append(now.is_catching_up)
    )
    assert list(cloud.stored) == [(0, k) for k in range(len(alone))]
    assert [content(data) for data in cloud.stored.values()] == [content(data) for data in contents(alone)]
    assert seen[-1] is False


def test_too_much_waiting_costs_places_and_then_time_but_no_keyscan(scans, alone, tmp_path, monkeypatch):
    """The cloud is away until the outbox is full."""
    cloud = FakeCloud()
    limit = sum(map(len, contents(alone))) // 3
    monkeypatch.setattr("fcslam.live.robot.LARGEST_OUTBOX_BYTES", limit)
    waits = []

    class Away(Network):
        def _next(self):
            return "none" if len(waits) > 3 else "request lost"

    def watch(now):
        if now.waiting.bytes >= limit:
            waits.append(now.scans)

    robot = drive(tmp_path, Away(cloud), scans, watch=watch)
    assert len(set(waits)) < len(waits), "the front end waited"
    places = [packet for packet in alone if isinstance(packet.body, Place)]
    sent = [decode(data).body for data in cloud.stored.values()]
    left_out = len(places) - sum(isinstance(body, Place) for body in sent)
    assert 0 < left_out == robot.status().left_out
    assert len(sent) == len(alone) - left_out
    assert list(cloud.stored) == [(0, k) for k in range(len(sent))]


def test_a_refused_packet_is_kept_with_its_reason(scans, alone, tmp_path):
    place = next(packet for packet in alone if isinstance(packet.body, Place))
    cloud = FakeCloud(unwanted={content(encode(place))})
    robot = drive(tmp_path, Network(cloud), scans)
    assert robot.status().refused == 1
    (kept,) = (tmp_path / "refused").glob("*.bin")
    assert content(kept.read_bytes()) == content(encode(place))
    assert kept.with_suffix(".txt").read_text() == "unwanted\n"
    assert len(cloud.stored) == len(alone) - 1


def test_an_announced_detector_is_taken_and_once_more_at_the_same_scan(scans, tmp_path):
    tiny_network(tmp_path / "tiny.onnx", version="tiny-2")
    file = describe_detector_file(tmp_path / "tiny.onnx")
    cloud = FakeCloud()

    def patient(records):
        for number, record in enumerate(records):
            if number == 20:
                cloud.detector_updates = {file: (tmp_path / "tiny.onnx").read_bytes()}
            while number == 20 and not list((tmp_path / "detectors").glob("*.onnx")):
                threading.Event().wait(0.01)
            yield record

    with pytest.raises(KeyboardInterrupt):
        drive(tmp_path, Network(cloud), stop_after(patient(scans), 70))
    robot = drive(tmp_path, Network(cloud), scans, resume=True)
    hellos = [decode(data).body for data in cloud.stored.values() if isinstance(decode(data).body, Hello)]
    assert [hello.detector_versions[Channel.CAMERA] == "tiny-2" for hello in hellos] == [False, True]
    assert robot.status().notices == ("detector tiny-2 from now on",)


def test_a_lost_robot_is_lost_until_the_cloud_has_found_it(tmp_path):
    """Put down elsewhere and, after another while, stopped and resumed: each part travels in an epoch of its own."""
    scans, moment = kidnapping()
    cloud = FakeCloud()
    with pytest.raises(KeyboardInterrupt):
        drive(tmp_path, Network(cloud), stop_after(scans, len(scans) - 5))
    seen = []
    robot = drive(tmp_path, Network(cloud), scans, resume=True, watch=lambda now: seen.append(now.localization))
    _, said = small_fleet.driven(scans, name="alice")
    assert {packet.epoch for packet in said} == {0, 1}
    assert [content(data) for data in cloud.stored.values()] == [content(data) for data in contents(said)]
    assert list(cloud.stored) == [(packet.epoch, packet.sequence) for packet in said]
    assert list(dict.fromkeys(seen)) == [LocalizationState.MAPPING, LocalizationState.LOST]
    assert robot.status().map_index is None
    assert robot.status().times_lost == 1
    stamps = robot.trajectory().stamps
    assert np.array_equal(stamps, [scan.stamp for scan in scans if scan.stamp >= stamps[0]])
    assert stamps[0] > moment, "where it was before is not known"


def test_a_full_disk_does_not_fill_the_memory(scans, tmp_path, monkeypatch):
    def put(_self, _packets):
        raise InputError("disk full")

    monkeypatch.setattr(Outbox, "put", put)
    wiring = Wiring(SameThread(), transport=Network(FakeCloud()))
    with Robot("alice", scans[0].laser, state=tmp_path, wiring=wiring) as robot:
        for scan in scans:
            robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
        with pytest.raises(InputError, match="disk full"):
            robot.finish()
        assert robot.status().keyscans > 5
        assert len(robot.save(tmp_path / "run").trajectories) == 1


def test_a_recording_is_played_by_its_own_clock():
    now, slept = 100.0, []

    def sleep(seconds):
        nonlocal now
        slept.append(seconds)
        now += seconds

    pace = PlaybackPace(2.0, lambda: now, sleep)
    for stamp in (5.0, 6.0, 8.0):
        pace.wait(stamp)
    now += 10.0  # mapping took long: nothing is left out, the recording just comes late
    pace.wait(9.0)
    assert slept == [0.0, 0.5, 1.0, 0.0]


def test_the_own_map_lies_where_the_server_puts_it(scans):
    cloud = FakeCloud(correction=CORRECTION.version)
    with Robot("alice", scans[0].laser, wiring=Wiring(SameThread(), transport=Network(cloud))) as robot:
        for scan in scans:
            pose = robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
        before = robot.map()
        assert robot.finish()
        T_map_odom = CORRECTION.T_map_odom
        path, drawn = robot.trajectory(), robot.map()
    assert np.allclose(path.T_map_base[0], T_map_odom, atol=0.02)
    assert path.map_index == CORRECTION.map_index
    if pose.map_index is not None:  # the reply came before the end
        assert np.allclose(pose.T_map_base, path.T_map_base[-1], atol=0.05)
    assert drawn.origin_xy != before.origin_xy or pose.map_index is not None
    column, row = np.floor((path.T_map_base[-1, :2] - drawn.origin_xy) / drawn.resolution_m).astype(int)
    assert drawn.cells[row, column] == Occupancy.FREE, "where the robot stands"


def test_a_server_that_is_away_is_told_once_and_what_waits_is_kept(scans, tmp_path):
    events, back = [], threading.Event()

    class Away(Network):
        def _next(self):
            self.requests += 1
            return "none" if back.is_set() else "request lost"

    network, pause = Away(FakeCloud()), threading.Event()
    wiring = Wiring(SameThread(), Clock(), transport=network)
    with Robot("alice", scans[0].laser, state=tmp_path, own_map=False, wiring=wiring,
               on_event=events.append) as robot:  # fmt: skip
        for scan in scans[:20]:
            robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
            while not network.requests:
                pause.wait(0.001)
        assert not robot.finish(timeout_s=5.0)
    assert not robot.finish(), "a closed robot sends nothing, so it does not wait"
    assert [event.kind for event in events] == [EventKind.OFFLINE]
    back.set()
    wiring = Wiring(SameThread(), transport=network)
    with Robot("alice", state=tmp_path, own_map=False, wiring=wiring) as robot:
        robot.finish()
    assert {epoch for epoch, _ in network.cloud.stored} == {0}


def test_a_server_that_turns_the_robot_away_stops_no_scan(scans, tmp_path):
    class Closed(Network):
        def state(self):
            raise CloudError("no token")

    events, pause = [], threading.Event()
    wiring = Wiring(SameThread(), Clock(), transport=Closed(FakeCloud()))
    with Robot("alice", scans[0].laser, state=tmp_path, wiring=wiring,
               on_event=events.append) as robot:  # fmt: skip
        while not events:
            robot.add_scan(scans[0].ranges_m, scans[0].stamp, scans[0].T_odom_base)
            pause.wait(0.001)
        for scan in scans[:10]:
            assert robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base).is_localized
        with pytest.raises(CloudError, match="no token"):
            robot.finish()
        robot.close()
    assert [(event.kind, event.text) for event in events] == [(EventKind.FAILED, "nothing is sent any more: no token")]
