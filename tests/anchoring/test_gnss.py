"""Fixes place a map on the earth, through an antenna beside the base; those that contradict the others bend nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import GnssFix, LaserModel, LaserScan, frozen
from fcslam.sources.bags.rosbag import RosBag
from fcslam.sources.bags.writer import write_bag
from fcslam.sources.faults import Fault
from tests.anchoring.test_plan import placed
from tests.planned_building import mapped

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
    return [GnssFix(float(k), *position, 400.0, sigma_m, ANTENNA) for k, position in enumerate(to_earth(at).tolist())]


def off_m(placing, true, T_earth_building):
    """Distance of each pose from the truth, by latitude and longitude; a degree of latitude is 111.2 km."""
    (robot,), place = placing.result.robots, json.loads(placing.files["map_georeference.json"])
    T_earth_map = np.array((0.0, 0.0, np.radians(place["x_axis_from_east_deg"])))
    expected = to_earth(se2.compose(np.array(T_earth_building), true)[:, :2])
    metres = 111_200.0 * np.array((1.0, np.cos(np.radians(ORIGIN[0]))))
    found = se2.compose(T_earth_map, robot.T_map_base)[:, :2]
    return np.hypot(*(found - ((expected - (place["latitude_deg"], place["longitude_deg"])) * metres)[:, ::-1]).T)


@pytest.mark.parametrize("T_earth_building", [(35.0, -20.0, 0.7), (-300.0, 500.0, -2.0)])
def test_fixes_place_a_map_on_the_earth(T_earth_building):
    result, true = mapped()
    placing = placed(result, fixes={"anna": fixes_of(true, T_earth_building, 0.05)})
    assert off_m(placing, true, T_earth_building).max() < 0.15


def test_fixes_that_contradict_the_others_bend_nothing():
    T, (result, true) = (35.0, -20.0, 0.7), mapped()
    fixes = fixes_of(true, T, wrong=slice(8, 17))
    placing = placed(result, fixes={"anna": fixes})
    assert json.loads(placing.files["map_georeference.json"])["ignored"] >= 9
    steps = se2.relative(placing.result.robots[0].T_map_base)
    assert np.abs(steps - se2.relative(true)).max() < 0.02
    assert off_m(placing, true, T).max() < 0.5


def test_fixes_that_leave_the_heading_open_place_nothing():
    result, true = mapped()
    placing = placed(result, fixes={"anna": fixes_of(true, (0.0, 0.0, 0.0), 8.0)})
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
    for one, names in ((result, ["anna"]), (both, ["anna", "bert"])):
        placing = placed(one, fixes=dict.fromkeys(names, fixes_of(true, (0.0, 0.0, 0.0), 2.0)))
        turns.append(
            float(json.loads(placing.files["map_georeference.json"])["reason"].split(" deg only")[0].split()[-1])
        )
    assert turns[1] < turns[0]


def test_a_map_that_a_user_placed_stays_and_is_found_on_the_earth():
    T, (result, true) = (35.0, -20.0, 0.7), mapped()
    placing = placed(result, fixes={"anna": fixes_of(true, T, 0.05)}, by_hand={0})
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
    write_bag(tmp_path / f"robot{suffix}", sorted([*scans, *sent], key=lambda record: record.stamp))
    bag = RosBag(tmp_path / f"robot{suffix}", "robot")
    found = [record for record in bag.records() if isinstance(record, GnssFix)]
    assert [fix.longitude_deg for fix in found] == [fix.longitude_deg for fix in sent if fix.latitude_deg]
    assert {fix.antenna_xy for fix in found} == {ANTENNA}
    assert {fix.sigma_m for fix in found} == {1.5}
    assert bag.faults[Fault.FIX_AT_ZERO].count == 1
