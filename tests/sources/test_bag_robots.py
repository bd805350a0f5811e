"""Robots of one bag: each is read as from a bag that has its messages alone."""

import copy
import math

import numpy as np
import pytest

import fcslam
from fcslam.errors import SourceError
from fcslam.sources import BagOptions, open_fleet, open_source
from fcslam.sources.bags.options import BagCorrection
from fcslam.sources.inspection import inspect
from tests.sources.bag_messages import BEAMS, drive, odom, pose_at, quaternion, save, scan, tf
from tests.sources.camera_records import same
from tests.sources.carmen_text import refusal, scans_of

pytestmark = pytest.mark.slow

MOUNTINGS = (0.2, 0.05, 0.1), (-0.1, 0.0, 2.0)


def robot(number, space="", prefix="", start=100.0, scans=20, with_odom=True, with_tf=False, shared=()):
    """The messages of a robot in a namespace, with a prefix of frames; ``shared`` are topics outside its namespace."""

    def topic(name):
        return f"/{name}" if name in shared else f"{space}/{name}"

    x, y, theta = MOUNTINGS[number]
    said = [tf(start, f"{prefix}base_link", f"{prefix}laser", (x, y, 0.3), quaternion(theta), topic("tf_static"))]
    for step in range(2 * scans + 1):
        at = 0.1 * step
        px, py, ptheta = pose_at(at + 50.0 * number)
        if with_odom:
            said.append(odom(start + at, (px, py, ptheta), topic("odom"), child=f"{prefix}base_link"))
        if with_tf:
            said.append(
                tf(start + at, f"{prefix}odom", f"{prefix}base_link", (px, py, 0.0), quaternion(ptheta), topic("tf"))
            )
        if step % 2:
            ranges = tuple(1.0 + number + 0.01 * step + 0.1 * beam for beam in range(BEAMS))
            said.append(scan(start + at - 0.05, ranges, topic("scan"), start + at + 0.01, frame=f"{prefix}laser"))
    return said


PREFIXED = {"with_tf": True, "shared": ("tf", "tf_static")}
FLEETS = {
    "namespaces": [{"space": f"/robot{k}"} for k in (1, 2)],
    "tf alone in namespaces": [{"space": f"/robot{k}", "with_odom": False, "with_tf": True} for k in (1, 2)],
    "prefixes in one tf": [{**PREFIXED, "space": f"/robot{k}", "prefix": f"robot{k}/"} for k in (1, 2)],
    "prefixes in one tf without topics of odometry": [
        {**PREFIXED, "space": f"/robot{k}", "prefix": f"robot{k}/", "with_odom": False} for k in (1, 2)
    ],
    "all on the same topics": [{"prefix": f"robot{k}/", "with_tf": True} for k in (1, 2)],
    "namespaces in a namespace": [{"space": f"/fleet/robot{k}", "with_tf": True} for k in (1, 2)],
    "one without a namespace": [{"with_tf": True}, {"space": "/robot2", "with_tf": True}],
}


def same_scans(found, expected):
    """Whether two sources give the same scans, to the last bit."""
    scans, wanted = scans_of(found), scans_of(expected)
    return len(scans) == len(wanted) and all(map(same, scans, wanted))


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
@pytest.mark.parametrize("fleet", FLEETS.values(), ids=FLEETS)
def test_each_robot_of_a_bag_is_read_as_if_it_were_alone(tmp_path, fleet, suffix):
    said = [robot(number, start=100.0 + 0.013 * number, **keys) for number, keys in enumerate(fleet)]
    path = save(tmp_path / f"fleet{suffix}", [message for each in said for message in each])
    robots = open_fleet([(path, None)])
    assert len(robots) == 2
    for found, own in zip(robots, said, strict=True):
        alone = open_source(save(tmp_path / f"{found.name}_alone{suffix}", own))
        assert same_scans(found, alone)
        assert found.survey().notes == ()
        chosen = open_source(tmp_path / f"fleet{suffix}:{found.robot.name}")
        assert chosen.name in (found.name, "")
        assert same_scans(chosen, alone)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_bag_of_two_robots_is_decoded_once(tmp_path, suffix):
    """After the first pass, all others need no file: of the other robot, of a corrected bag, of copies."""
    path = save(tmp_path / f"fleet{suffix}", [message for number in (0, 1) for message in robot(number, f"/r{number}")])
    robots = open_fleet([(path, None)])
    robots[0].survey()
    path.unlink()
    for found in robots:
        later = found.corrected(BagCorrection(odometry_delay_s=0.02), ("late",))
        for source in (found, copy.copy(found), later):
            assert len(scans_of(source)) == source.survey().scan_count == 20


def fleet_bag(folder, kind="namespaces", name="fleet.mcap"):
    said = [robot(number, **keys) for number, keys in enumerate(FLEETS[kind])]
    return save(folder / name, [message for each in said for message in each])


def test_where_one_robot_is_needed_all_are_named(tmp_path):
    path = fleet_bag(tmp_path)
    message = refusal(path)
    assert "has the robots /robot1, /robot2" in message
    assert "fleet.mcap:/robot1" in message
    assert "no robot /robot3, it has /robot1, /robot2" in refusal(path, BagOptions(robot="robot3"))


def test_a_robot_may_have_another_name(tmp_path):
    path = fleet_bag(tmp_path)
    anna, *others = open_fleet([(tmp_path / "fleet.mcap:robot1", "anna")])
    assert (anna.name, others) == ("anna", [])
    assert [each.name for each in open_fleet([(path, "day1")])] == ["day1_robot1", "day1_robot2"]


def test_named_topics_are_those_of_their_robot(tmp_path):
    path = fleet_bag(tmp_path)
    for options in (BagOptions(("/robot2/scan",)), BagOptions(odom_topic="/robot2/odom")):
        (only,) = open_fleet([(path, None)], options)
        assert only.plan.odometry.name == "/robot2/odom"
        assert only.survey().lasers[0].T_base_laser[:2] == MOUNTINGS[1][:2]


def test_each_robot_has_its_own_of_the_named_lasers(tmp_path):
    said = [robot(number, space=f"/r{number}") for number in (0, 1)]
    said += [[each._replace(topic=f"/r{k}/rear") for each in said[k] if each.topic == f"/r{k}/scan"] for k in (0, 1)]
    path = save(tmp_path / "fleet.mcap", [message for each in said for message in each])
    poses = [(0.1 * k, 0.0, 0.0) for k in range(4)]
    options = BagOptions(("/r0/scan", "/r1/scan", "/r0/rear", "/r1/rear"), laser_poses=tuple(poses))
    lasers = [[laser.T_base_laser for laser in each.survey().lasers] for each in open_fleet([(path, None)], options)]
    assert lasers == [[poses[0], poses[2]], [poses[1], poses[3]]]


def test_the_robots_of_a_bag_are_listed(tmp_path):
    found = inspect(fleet_bag(tmp_path, "prefixes in one tf"))
    assert [str(each.path).rpartition(":")[2] for each in found.robots] == ["/robot1", "/robot2"]
    assert [each.odometry_from for each in found.robots] == ["/robot1/odom", "/robot2/odom"]
    assert all(each.scans == 20 and each.problem is None for each in found.robots)


@pytest.mark.parametrize("kind", ["namespaces", "all on the same topics", "one without a namespace"])
def test_one_recording_given_twice_is_refused(tmp_path, kind):
    path = fleet_bag(tmp_path, kind)
    linked = tmp_path / "linked.mcap"
    linked.symlink_to(path)
    for twice in ([path, path], [path, linked], [path, tmp_path / "fleet.mcap:/robot2"]):
        with pytest.raises(SourceError, match=r"have the same scans at .* s, so they are copies"):
            fcslam.map_recordings({f"name{number}": each for number, each in enumerate(twice)})


def two_frames(rear_in_tf=True):
    """The scans of two lasers in turn on one topic."""
    mounts = [tf(100.0, "base_link", "front", (0.2, 0.0, 0.3), topic="/tf_static")]
    if rear_in_tf:
        mounts.append(tf(100.0, "base_link", "rear", (-0.2, 0.0, 0.3), quaternion(math.pi), topic="/tf_static"))
    said = [each for each in drive(40) if each.topic not in ("/tf_static", "/scan")]
    scans = [each for each in drive(40) if each.topic == "/scan"]
    for number, each in enumerate(scans):
        said.append(each._replace(fields={**each.fields, "frame": ("front", "rear")[number % 2]}))
    return [*mounts, *said]


def test_the_frames_on_one_topic_are_lasers_of_one_robot(tmp_path):
    source = open_source(save(tmp_path / "run.mcap", two_frames()))
    scans = scans_of(source)
    assert len(scans) == 40
    assert {each.laser.T_base_laser for each in scans[::2]} == {(0.2, 0.0, 0.0)}
    assert {each.laser.T_base_laser[:2] for each in scans[1::2]} == {(-0.2, 0.0)}
    assert all(abs(each.laser.T_base_laser[2]) == pytest.approx(math.pi) for each in scans[1::2])


def test_a_frame_that_tf_lacks_is_named(tmp_path):
    path = save(tmp_path / "run.mcap", two_frames(rear_in_tf=False))
    assert "no transform from 'base_link' to 'rear', so the pose of the laser of /scan in 'rear' is unknown" in refusal(
        path
    )
    assert "for the lasers /scan in 'front', /scan in 'rear'" in refusal(path, BagOptions(laser_poses=((0, 0, 0),)))
    poses = ((0.2, 0.0, 0.0), (-0.2, 0.0, 3.0))
    assert [laser.T_base_laser for laser in open_source(path, BagOptions(laser_poses=poses)).survey().lasers] == [
        *poses
    ]


def test_a_frame_between_two_robots_is_refused_by_name(tmp_path):
    said = [message for k in (0, 1) for message in robot(k, prefix=f"robot{k}/", with_tf=True)]
    said += [scan(101.0 + 0.1 * k, frame="lost") for k in range(20)]
    path = save(tmp_path / "run.mcap", said)
    with pytest.raises(SourceError, match=r"/scan has scans of the frames 'robot0/laser' and 'lost'.*; record /tf"):
        open_fleet([(path, None)])


def above(*links, odometry="odom"):
    """A drive whose odometry is in tf alone, with other transforms that move."""
    said = [each for each in drive(40) if each.topic != "/odom"]
    for step in range(80):
        at = 0.1 * step
        x, y, theta = pose_at(at)
        for parent, child in links:
            said.append(tf(100.0 + at, parent, child, (0.03 * at, 0.5, 0.0)))
        said.append(tf(100.0 + at, odometry, "base_link", (x, y, 0.0), quaternion(theta)))
    return said


@pytest.mark.parametrize(
    ("links", "odometry"),
    [
        ([("camera_odom_frame", "camera_pose_frame")], "odom"),
        ([("odom_icp", "odom")], "odom"),
        ([("map", "world")], "world"),
        ([("base_link", "wheel"), ("arm", "odometer")], "world"),
    ],
)
def test_the_odometry_is_what_moves_above_the_laser(tmp_path, links, odometry):
    source = open_source(save(tmp_path / "run.mcap", above(*links, odometry=odometry)))
    assert source.plan.odometry.edge == (odometry, "base_link")
    poses = np.array([each.T_odom_base for each in scans_of(source)])
    expected = np.array([pose_at(0.2 * step + 0.05) for step in range(len(poses))])
    assert np.abs(poses[:, :2] - expected[:, :2]).max() < 0.002


def test_a_pose_in_a_map_is_odometry_only_if_it_is_named(tmp_path):
    path = save(tmp_path / "run.mcap", above(odometry="map"))
    assert open_source(path).plan.odometry is None
    for options in (BagOptions(odom_frame="map"), BagOptions(odom_frame="map", base_frame="base_link")):
        assert open_source(path, options).plan.odometry.edge == ("map", "base_link")


def test_frames_that_are_not_there_are_refused_with_those_that_are(tmp_path):
    path = save(tmp_path / "run.mcap", above(("odom_icp", "odom")))
    message = refusal(path, BagOptions(odom_frame="odometry"))
    assert "no transform from odometry" in message
    assert "odom_icp -> odom" in message
    assert "no transform from a frame to robot" in refusal(path, BagOptions(base_frame="robot"))


def test_odometry_of_frames_that_are_not_the_robots_is_not_used(tmp_path):
    said = [*drive(40), *(odom(100.0 + 0.02 * k, (0.01 * k, 0, 0), "/camera/odom", child="camera") for k in range(400))]
    path = save(tmp_path / "run.mcap", [each for each in said if each.topic != "/none"])
    source = open_source(path)
    assert source.plan.odometry.name == "/odom"
    assert "/camera/odom is not used, as its namespace or frames are not those of" in " ".join(source.survey().notes)
    assert open_source(path, BagOptions(odom_topic="/camera/odom")).plan.odometry.name == "/camera/odom"


def test_odometry_of_a_robot_without_scans_is_not_used(tmp_path):
    own, other = robot(0, space="/robot1"), robot(1, space="/robot2", scans=40)
    path = save(tmp_path / "run.mcap", [*own, *(each for each in other if "scan" not in each.topic)])
    (found,) = open_fleet([(path, None)])
    assert found.plan.odometry.name == "/robot1/odom"
    assert same_scans(found, open_source(save(tmp_path / "alone.mcap", own)))


def test_the_lasers_of_two_robots_may_have_one_name(tmp_path):
    said = [robot(k, **FLEETS["prefixes in one tf"][k]) for k in (0, 1)]
    for each in (message.fields for messages in said for message in messages):
        each.update({key: "laser" for key in ("frame", "child") if str(each.get(key)).endswith("/laser")})
    robots = open_fleet([(save(tmp_path / "run.mcap", [message for each in said for message in each]), None)])
    assert [each.survey().lasers[0].T_base_laser for each in robots] == [pytest.approx(each) for each in MOUNTINGS[:2]]


def test_a_robot_without_odometry_does_not_spoil_the_other(tmp_path):
    own = robot(0, space="/robot1", with_tf=True)
    other = [each for each in robot(1, space="/robot2") if each.topic != "/robot2/odom"]
    (found,) = open_fleet([(save(tmp_path / "run.mcap", [*own, *other]), None)])
    assert same_scans(found, open_source(save(tmp_path / "alone.mcap", own)))
    assert any("on /robot2/scan belong to no robot with odometry; not used" in note for note in found.survey().notes)


def test_robots_without_namespaces_and_prefixes_are_named_by_their_frames(tmp_path):
    said = [robot(k, prefix=f"r{k}_", with_odom=False, with_tf=True) for k in (0, 1)]
    robots = open_fleet([(save(tmp_path / "run.mcap", [message for each in said for message in each]), None)])
    assert [each.name for each in robots] == ["r0", "r1"]


def test_scans_and_odometry_of_a_camera_on_the_robot_are_no_robot(tmp_path):
    said = [*drive(40), tf(100.0, "base_link", "camera", (0.1, 0.0, 0.5), topic="/tf_static")]
    said += [odom(100.0 + 0.1 * k, pose_at(0.1 * k), "/camera/odom") for k in range(80)]
    said += [scan(100.05 + 0.2 * k, (1.0,) * 5, "/camera/scan", frame="camera") for k in range(39)]
    (source,) = open_fleet([(save(tmp_path / "run.mcap", said), None)])
    assert [laser.name for laser in source.plan.lasers] == ["/scan"]


def test_all_robots_of_a_bag_are_mapped(tmp_path):
    path = fleet_bag(tmp_path)
    alone = open_source(save(tmp_path / "run.mcap", drive(20)))
    run = fcslam.map_recordings([path, alone], config={"fleet": {"join_maps": False}})
    assert sorted(run.trajectories) == ["robot1", "robot2", "run"]
    assert [*fcslam.map_recordings(f"{path}:/robot2").trajectories] == ["robot2"]


def test_one_robot_is_localized_by_its_name(tmp_path):
    path = fleet_bag(tmp_path)
    fcslam.map_recordings(f"{path}:/robot1", output=tmp_path / "run")
    with pytest.raises(SourceError, match="has the robots /robot1, /robot2; choose one"):
        fcslam.localize(path, tmp_path / "run")
