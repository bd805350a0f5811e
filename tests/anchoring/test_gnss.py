"""Fixes place a map on the earth, through an antenna beside the base; those that contradict the others bend nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.anchoring.anchors import anchoring_lines
from fcslam.api import map_recordings
from fcslam.geometry import se2
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import GnssFix, Keyscan, KeyscanFix, KeyscanId, LaserModel, LaserScan, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources.bags.codec import FIX
from fcslam.sources.bags.rosbag import RosBag
from fcslam.sources.bags.writer import write_bag
from fcslam.sources.faults import Fault
from tests.anchoring.test_plan import placed
from tests.planned_building import LASER, WALLS, mapped, ranges_at, sides, true_poses
from tests.sources.bag_messages import CODECS, Said, drive, header, save

pytestmark = pytest.mark.slow

pyproj = pytest.importorskip("pyproj")

ORIGIN = (47.3769, 8.5417, 400.0)
ANTENNA = (-0.3, 0.2)
SIGMA_M = 0.3


def to_earth(east_north):
    """Latitudes and longitudes of points (N, 2) by the topocentric frame: not the projection of the package."""
    latitude, longitude, altitude = ORIGIN
    frame = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +lat_0={latitude} +lon_0={longitude} +h_0={altitude} +ellps=WGS84"
    )
    lon, lat, _ = frame.transform(*np.asarray(east_north).T, np.zeros(len(east_north)), direction="INVERSE")
    return np.column_stack((lat, lon))


def fixes_of(true, T_earth_building, sigma_m=SIGMA_M, wrong=slice(0, 0)):
    rng = np.random.default_rng(3)
    at = np.array([se2.transform(se2.compose(T_earth_building, pose), np.array([ANTENNA]))[0] for pose in true])
    at += rng.normal(0.0, sigma_m, at.shape)
    at[wrong] += (6.0, -4.0)
    fixes = enumerate(to_earth(at).tolist())
    return tuple(KeyscanFix(KeyscanId("anna", k), *position, 400.0, sigma_m, ANTENNA) for k, position in fixes)


def fixed(result, fixes):
    """The result whose robots have these fixes."""
    return replace(result, robots=tuple(replace(robot, fixes=fixes) for robot in result.robots))


def off_m(placing, true, T_earth_building):
    """Distance of each pose from the truth, by latitude and longitude."""
    (robot,), place = placing.result.robots, json.loads(placing.files["map_georeference.json"])
    T_earth_map = np.array((0.0, 0.0, np.radians(place["x_axis_from_east_deg"])))
    return off_by(place, se2.compose(T_earth_map, robot.T_map_base), true, T_earth_building)


def off_by(place, found, true, T_earth_building):
    """Distance of each pose, of axes east and north, from the truth; a degree of latitude is 111.2 km."""
    expected = to_earth(se2.compose(np.array(T_earth_building), true)[:, :2])
    metres = 111_200.0 * np.array((1.0, np.cos(np.radians(ORIGIN[0]))))
    east_north = ((expected - (place["latitude_deg"], place["longitude_deg"])) * metres)[:, ::-1]
    return np.hypot(*(found[:, :2] - east_north).T)


@pytest.mark.parametrize("T_earth_building", [(35.0, -20.0, 0.7), (-300.0, 500.0, -2.0)])
def test_fixes_place_a_map_on_the_earth(T_earth_building):
    result, true = mapped()
    placing = placed(fixed(result, fixes_of(true, T_earth_building, 0.05)))
    assert off_m(placing, true, T_earth_building).max() < 0.15


def test_errors_that_are_larger_than_stated_are_found():
    T, (result, true) = (35.0, -20.0, 0.7), mapped()
    fixes = tuple(replace(fix, sigma_m=0.01) for fix in fixes_of(true, T))
    placing = placed(fixed(result, fixes))
    assert off_m(placing, true, T).mean() < SIGMA_M
    assert json.loads(placing.files["map_georeference.json"])["sigma_m"] == pytest.approx(SIGMA_M, rel=0.3)
    (line,) = (each for each in anchoring_lines(placing.files) if "covariance" in each)
    assert "their covariance says 0.01 m; 0.26 m is used" in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p[:, ::-1], "with latitude and longitude exchanged"),
        (np.radians, "with radians for degrees"),
        (lambda p: p * (1.0, -1.0), "with east and north exchanged, or a sign lost"),
        (lambda p: np.trunc(p) + 0.6 * (p - np.trunc(p)), "with a scale of 0.6"),
    ],
)
def test_coordinates_that_are_wrong_place_nothing_and_are_named(change, words):
    result, true = mapped()
    fixes = fixes_of(true, (35.0, -20.0, 0.7), 0.05)
    wrong = change(np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])).tolist()
    both = zip(fixes, wrong, strict=True)
    placing = placed(fixed(result, tuple(replace(fix, latitude_deg=a, longitude_deg=b) for fix, (a, b) in both)))
    found = json.loads(placing.files["map_georeference.json"])
    assert not found["georeferenced"]
    assert words in found["reason"]


def test_fixes_that_contradict_the_others_bend_nothing():
    T, (result, true) = (35.0, -20.0, 0.7), mapped()
    fixes = fixes_of(true, T, wrong=slice(8, 17))
    placing = placed(fixed(result, fixes))
    assert json.loads(placing.files["map_georeference.json"])["ignored"] >= 9
    steps = se2.relative(placing.result.robots[0].T_map_base)
    assert np.abs(steps - se2.relative(true)).max() < 0.02
    assert off_m(placing, true, T).max() < 0.5


def test_fixes_that_are_too_few_to_check_each_other_place_nothing():
    """Three of them may agree and be wrong, as by one reflection."""
    result, true = mapped()
    placing = placed(fixed(result, fixes_of(true, (35.0, -20.0, 0.7), 0.05)[::9][:3]))
    (line,) = (line for line in anchoring_lines(placing.files) if "earth" in line)
    assert line.endswith("3 of 3 fixes agree, 10 needed: fewer do not show which are wrong")


def test_fixes_that_leave_the_heading_open_place_nothing():
    result, true = mapped()
    placing = placed(fixed(result, fixes_of(true, (0.0, 0.0, 0.0), 8.0)))
    assert not json.loads(placing.files["map_georeference.json"])["georeferenced"]
    assert np.array_equal(placing.result.robots[0].T_map_base, result.robots[0].T_map_base)


def test_fixes_of_several_robots_at_one_time_are_no_more_frequent_for_it():
    """The second robot's errors are independent, so the heading is known better; pooled gaps would say the opposite."""
    result, true = mapped()
    (robot,), count = result.robots, len(true)
    bert = replace(robot, robot="bert", variables=robot.variables + count)
    edges = [Edge(e.i + count, e.j + count, e.T_i_j, e.information, e.robust) for e in result.graph.edges]
    joined = Edge(0, count, np.zeros(3), np.eye(3) * 1e4, robust=False)
    poses = np.concatenate((result.graph.poses(), robot.T_map_base))
    graph = PoseGraph(poses, [*result.graph.edges, *edges, joined])
    both = replace(result, robots=(robot, bert), graph=graph)
    turns = []
    for one in (result, both):
        placing = placed(fixed(one, fixes_of(true, (0.0, 0.0, 0.0), 2.0)))
        turns.append(
            float(json.loads(placing.files["map_georeference.json"])["reason"].split(" deg only")[0].split()[-1])
        )
    assert turns[1] < turns[0]


def test_a_map_that_a_user_placed_stays_and_is_found_on_the_earth():
    T, (result, true) = (35.0, -20.0, 0.7), mapped()
    placing = placed(fixed(result, fixes_of(true, T, 0.05)), by_hand={0})
    assert np.array_equal(placing.result.robots[0].T_map_base, result.robots[0].T_map_base)
    assert off_m(placing, true, T).max() < 0.15


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_a_bag_gives_its_fixes_and_names_those_at_zero(tmp_path, suffix):
    laser = LaserModel(90, -np.pi, np.radians(4.0), 10.0)
    scans = [
        LaserScan(1000.0 + k, frozen(np.full(90, 3.0), np.float32), laser, frozen((0.1 * k, 0.0, 0.0)))
        for k in range(12)
    ]
    sent = [GnssFix(1000.25 + k, 47.0, 8.5 + 1e-6 * k, 400.0, 1.5, ANTENNA) for k in range(10)]
    sent[4] = GnssFix(1004.25, 0.0, 0.0, 0.0, 1.5, ANTENNA)
    sent[6] = GnssFix(1e6, 47.0, 8.5, 400.0, 1.5, ANTENNA)  # keeps none of the later ones away
    write_bag(tmp_path / f"robot{suffix}", sorted([*scans, *sent], key=lambda record: min(record.stamp, 1006.25)))
    bag = RosBag(tmp_path / f"robot{suffix}", "robot")
    found = [record for record in bag.records() if isinstance(record, GnssFix)]
    assert [fix.longitude_deg for fix in found] == [fix.longitude_deg for fix in sent if fix.latitude_deg][:5] + [
        fix.longitude_deg for fix in sent[7:]
    ]
    assert {fix.antenna_xy for fix in found} == {ANTENNA}
    assert {fix.sigma_m for fix in found} == {1.5}
    assert bag.faults[Fault.FIX_AT_ZERO].count == 1


def fix_message(stamp, status, latitude=47.0):
    codec = CODECS[False]
    named = {"header": header(stamp, "gps"), "status": codec.make("sensor_msgs/NavSatStatus", status=status)}
    return codec.encode(codec.make(FIX, **named, latitude=latitude, longitude=8.5), FIX)


def test_fixes_of_each_status_are_used_or_counted_by_the_clock_of_the_scans(tmp_path):
    messages = drive(200)
    for k, status in enumerate((0, -1, -2, -2) * 9):
        at, ahead = 100.0 + k, fix_message(118.0 + k, status)
        messages.append(Said("/fix", FIX, at, {"payload": ahead}))
    messages.append(Said("/fix", FIX, 136.0, {"payload": fix_message(154.0, 0, 121.0)}))
    bag = RosBag(save(tmp_path / "run.mcap", messages), "run")
    found = [record.stamp for record in bag.records() if isinstance(record, GnssFix)]
    assert found == pytest.approx([100.0 + k for k in range(36) if k % 4 != 1], abs=0.1)
    counts = {kind: bag.faults[kind].count for kind in bag.faults.counts}
    assert counts == {Fault.NO_FIX: 9, Fault.UNKNOWN_FIX: 18, Fault.NO_LATITUDE: 1}
    assert "the clock of /fix is 18.0" in " ".join(bag.survey().notes)


def test_fixes_are_part_of_the_mission_and_place_it_again(tmp_path):
    T, true, walls = (35.0, -20.0, 0.7), true_poses(), sides(WALLS)
    scans = [
        LaserScan(float(k), frozen(ranges_at(pose, walls), np.float32), LASER, frozen(se2.between(true[0], pose)))
        for k, pose in enumerate(true)
    ]
    measured = fixes_of(true, T, 0.05)
    fixes = [
        GnssFix(k + 0.3, fix.latitude_deg, fix.longitude_deg, 400.0, 0.1, ANTENNA) for k, fix in enumerate(measured)
    ]
    write_bag(tmp_path / "anna.bag", sorted([*scans, *fixes], key=lambda record: record.stamp))
    first = map_recordings(tmp_path / "anna.bag", output=tmp_path / "run")
    again = map_recordings([], onto=tmp_path / "run")
    place = json.loads(first.map_files["map_georeference.json"])
    assert place["fixes"] > 0.9 * len(true)
    assert place["ignored"] == 0
    assert first.map_files == again.map_files
    found = np.concatenate([each.T_map_base for each in first.trajectories.values()])
    assert off_by(place, found, true, T).max() < 0.15


def test_a_fix_is_sent_with_the_keyscan_of_the_scan_next_to_it():
    """The antenna in the base of the keyscan is where the truth has it."""
    steps = np.arange(30)
    true, walls = np.column_stack((1.0 + 0.1 * steps, np.full(30, 3.0), 0.02 * steps)), sides(WALLS)
    robot, packets = RobotFrontend("anna", RobotConfig()), []
    for k, pose in enumerate(true):
        odometry = frozen(se2.between(true[0], pose))
        if k % 2:  # not at every keyscan itself
            packets += robot.process(GnssFix(k - 0.1, 47.0, 8.0 + k, 400.0, 1.0, ANTENNA))
        packets += robot.process(LaserScan(float(k), frozen(ranges_at(pose, walls), np.float32), LASER, odometry))
    packets += robot.process(GnssFix(99.0, 47.0, 99.0, 400.0, 1.0, ANTENNA))
    packets += robot.finish()
    at = {packet.body.id.number: packet.body.stamp for packet in packets if isinstance(packet.body, Keyscan)}
    sent = [packet.body for packet in packets if isinstance(packet.body, KeyscanFix)]
    assert len(sent) >= 9
    for fix in sent:
        scan = round(fix.longitude_deg - 8.0)
        keyscan = true[round(at[fix.id.number])]
        expected = se2.transform(se2.between(keyscan, true[scan]), np.array([ANTENNA]))[0]
        assert fix.antenna_xy == pytest.approx(tuple(expected), abs=0.02)
    assert len({fix.id for fix in sent}) == len(sent)
