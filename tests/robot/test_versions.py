"""A robot gets another detector on the way: what it sends from then on, and what becomes of its places of before."""

from dataclasses import replace
from functools import cache

import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import FeatureError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.features.detector_file import describe_detector_file
from fcslam.features.detector_kinds import DetectorKind
from fcslam.records import Channel, LaserScan, Place
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.views import ViewsConfig
from fcslam.wire.messages import Hello
from fcslam.wire.packets import encode
from tests.features.networks import tiny_network
from tests.robot.test_views import records_of
from tests.small_fleet import fingerprint

pytestmark = pytest.mark.slow

WITH_ORB = RobotConfig(channels=(Channel.CAMERA,), views=ViewsConfig(detector=DetectorKind.ORB))
WITH_NETWORK = RobotConfig(channels=(Channel.CAMERA,))


@cache
def shipped():
    return describe_detector_file(BUNDLED_NETWORK)


@pytest.fixture(scope="module")
def seen():
    return records_of([(1.5, 1.5), (12.5, 1.5)], 10)[0]


def driven(robot, records, switch_after=None):
    """All packets of a drive; after so many records the robot takes the network that comes with fcslam."""
    packets = []
    for number, record in enumerate(records):
        if number == switch_after:
            robot.set_detector(shipped(), BUNDLED_NETWORK)
        packets += robot.process(record)
    return packets + robot.finish()


def places(packets, version):
    return [p.body for p in packets if isinstance(p.body, Place) and p.body.detector_version == version]


def test_old_places_are_described_again_and_new_ones_by_the_new_detector_alone(seen):
    half = len(seen) // 2
    robot = RobotFrontend("r", WITH_ORB)
    packets = driven(robot, seen, half)
    hellos = [k for k, packet in enumerate(packets) if isinstance(packet.body, Hello)]
    first, second = (packets[k].body for k in hellos)
    assert first.lasers == second.lasers
    orb = first.detector_versions[Channel.CAMERA]
    assert second.detector_versions == {Channel.CAMERA: shipped().version}
    before, after = packets[: hellos[1]], packets[hellos[1] :]
    assert places(before, orb)
    assert not places(before, shipped().version)
    assert not places(after, orb)
    old = {place.id: (place.first, place.last) for place in places(before, orb)}
    described = {place.id: (place.first, place.last) for place in places(after, shipped().version)}
    assert old.items() <= described.items()
    assert max(described) > max(old)
    # As if it had never had another: where the detector is the same, so are its places.
    always = driven(RobotFrontend("r", WITH_NETWORK), seen)
    assert content(after).items() <= content(always).items()


def content(packets):
    """Places as bytes, whenever they were sent."""
    return {p.body.id: encode(replace(p, sequence=0, time=1e9)) for p in packets if isinstance(p.body, Place)}


def test_a_detector_that_comes_before_the_first_scan_is_announced_once(seen):
    packets = driven(RobotFrontend("r", WITH_ORB), seen[:40], 0)
    (hello,) = [packet.body for packet in packets if isinstance(packet.body, Hello)]
    assert hello.detector_versions == {Channel.CAMERA: shipped().version}


def test_going_back_and_forth_describes_nothing_twice(seen, tmp_path):
    """A release that was withdrawn: places of the version before are there already."""
    tiny_network(tmp_path / "tiny.onnx", version="tiny-1")
    robot, packets = RobotFrontend("r", WITH_NETWORK), []
    changes = {len(seen) // 3: tmp_path / "tiny.onnx", len(seen) // 2: BUNDLED_NETWORK, len(seen) - 1: BUNDLED_NETWORK}
    for number, record in enumerate(seen):
        if number in changes:
            robot.set_detector(describe_detector_file(changes[number]), changes[number])
        packets += robot.process(record)
    robot.set_detector(describe_detector_file(tmp_path / "tiny.onnx"), tmp_path / "tiny.onnx")
    packets += robot.finish()  # the last change is reported even though no scan comes after it
    announced = [packet.body.detector_versions[Channel.CAMERA] for packet in packets if isinstance(packet.body, Hello)]
    assert announced == [shipped().version, "tiny-1", shipped().version, "tiny-1"]
    described = [(p.body.id, p.body.detector_version) for p in packets if isinstance(p.body, Place)]
    assert len(described) == len(set(described))
    assert {id for id, version in described if version == "tiny-1"} == {id for id, _ in described}
    received(packets)  # and the cloud takes all of it


def test_what_is_not_the_file_that_was_announced_changes_nothing(seen, tmp_path):
    tiny_network(tmp_path / "tiny.onnx", version="tiny-1")
    tiny = describe_detector_file(tmp_path / "tiny.onnx")
    (tmp_path / "cut.onnx").write_bytes((tmp_path / "tiny.onnx").read_bytes()[:-1])
    robot = RobotFrontend("r", WITH_ORB)
    for file, path, reason in (
        (shipped(), tmp_path / "tiny.onnx", "is not the file"),
        (tiny, tmp_path / "cut.onnx", "is not the file"),
        (tiny, tmp_path / "missing.onnx", "cannot be read"),
        (replace(tiny, version="tiny-2"), tmp_path / "tiny.onnx", "holds detector tiny-1"),
        (replace(tiny, format=2), tmp_path / "tiny.onnx", "its format is 2"),
        (replace(tiny, channel=Channel.LIDAR), tmp_path / "tiny.onnx", "describes lidar places"),
    ):
        with pytest.raises(FeatureError, match=reason):
            robot.set_detector(file, path).result()
    with pytest.raises(FeatureError, match="does not use detectors"):
        RobotFrontend("r", RobotConfig(channels=(Channel.LIDAR,))).set_detector(tiny, tmp_path / "tiny.onnx").result()
    untouched = driven(RobotFrontend("r", WITH_ORB), seen[:40])
    assert [encode(packet) for packet in driven(robot, seen[:40])] == [encode(packet) for packet in untouched]


@pytest.fixture(scope="module")
def fleet(seen):
    """Robot old drove with ORB and never met the other's words; robot new has had the network from the start."""
    others = records_of([(3.0, 1.6), (12.5, 1.6)], 11)[0]
    last = max(k for k, record in enumerate(seen) if isinstance(record, LaserScan))
    return {
        "switched": driven(RobotFrontend("old", WITH_ORB), seen, last),
        "stayed": driven(RobotFrontend("old", WITH_ORB), seen),
        "new": driven(RobotFrontend("new", WITH_NETWORK), others),
    }


def received(packets):
    cloud = Cloud(FleetConfig(), 0)
    for packet in packets:
        cloud.receive(encode(packet))
    return cloud.finalize()


def between(result):
    return [closure for closure in result.closures if closure.i.robot != closure.j.robot]


def test_places_of_before_match_what_others_see_once_they_are_described_again(fleet):
    joined = received([*fleet["switched"], *fleet["new"]])
    assert {robot.map_index for robot in joined.robots} == {0}
    described = {place.id for place in places(fleet["switched"], shipped().version)}
    of_old = {end for closure in between(joined) for end in (closure.i, closure.j) if end.robot == "old"}
    assert of_old
    assert of_old <= described
    # Whatever arrives first: old places, described again, meet places that are there already.
    other_way = received([*fleet["new"], *fleet["switched"]])
    assert fingerprint(other_way) == fingerprint(joined)


def test_codes_of_different_versions_are_not_compared(fleet):
    apart = received([*fleet["stayed"], *fleet["new"]])
    assert {robot.map_index for robot in apart.robots} == {0, 1}
    assert between(apart) == []
