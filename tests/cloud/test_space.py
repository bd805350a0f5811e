"""A fleet in space: robots with 3D LiDARs, robots with 2D LiDARs, and both in one map."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.report import keyscan_track, run_of
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError
from fcslam.geometry import se2, se3
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.mission.mission import MissionConfig, MissionInputs, run_mission
from fcslam.mission.mission_file import read_mission
from fcslam.records import ClosureStatus, ReasonCode, VoxelMap
from fcslam.runs import open_run
from fcslam.wire.packets import encode
from tests.cloud.space_fleet import BASE_M, GROUND, sent
from tests.flats import BACK, ROUND, Drive, flat
from tests.small_fleet import feed, fingerprint, map_of

pytestmark = pytest.mark.slow

SPACE = FleetConfig(dimensions=3)


def result_of(packets, config=SPACE):
    return feed(Cloud(config, 0), packets).finalize()


def reference():
    """The starts of both robots' grounds in one map, in the plane: T_a_b (3,)."""
    found = {robot.robot: robot.T_map_base[0] for robot in result_of(sent("A", "B"), FleetConfig()).robots}
    return se2.between(found["a"], found["b"])


def starts(result):
    """T_map_ground of the first keyscan of each robot, shape (7,)."""
    lean = {robot.robot: bool(robot.space.voxel_maps) for robot in result.robots}
    return {
        robot.robot: se3.compose(robot.space.T_map_base[0], se3.inverse(GROUND[robot.robot]))
        if lean[robot.robot]
        else robot.space.T_map_base[0]
        for robot in result.robots
    }


@pytest.mark.parametrize("robots", [("a", "b"), ("A", "b"), ("a", "B"), ("A", "B")])
def test_robots_share_one_level_map_whatever_their_lidars(robots):
    result = result_of(sent(*robots))
    assert map_of(result) == {"a": 0, "b": 0}
    found = starts(result)
    T_a_b = se3.between(found["a"], found["b"])
    off = se2.between(reference(), se3.to_plane(T_a_b))
    assert np.hypot(*off[:2]) < 0.04
    assert abs(off[2]) < 0.01
    assert abs(T_a_b[2]) < 0.05, "both stand on one floor"
    up = se3.rotation(np.array(list(found.values())))[:, 2, 2]
    assert np.arccos(up.clip(-1.0, 1.0)).max() < 0.02, "the map is level although bases lean"


def test_results_depend_on_the_set_of_packets_alone():
    packets = sent("a", "b")
    one = result_of(packets)
    late = Cloud(SPACE, 0)
    for robot in ("b", "a"):
        feed(late, [packet for packet in packets if packet.robot == robot])
    other = late.finalize()
    assert fingerprint(one) == fingerprint(other)
    for a, b in zip(one.robots, other.robots, strict=True):
        assert a.space.T_map_base.tobytes() == b.space.T_map_base.tobytes()


def test_a_restored_fleet_goes_on_to_the_same_bytes():
    packets = sent("a", "b")
    whole, half = Cloud(SPACE, 0), Cloud(SPACE, 0)
    feed(whole, packets)
    feed(half, packets[: 2 * len(packets) // 3])
    state = half.state()
    again = Cloud(SPACE, 0)
    again._packets = half._packets
    again.restore(state)
    feed(again, packets[2 * len(packets) // 3 :])
    assert fingerprint(again.finalize()) == fingerprint(whole.finalize())


def test_surfaces_in_space_that_the_other_robot_saw_through_keep_maps_apart():
    """Shelves over the heads: no 2D LiDAR sees them, and in the plane the maps join."""
    x, y = np.meshgrid(np.arange(-2.0, 2.0, 0.1), np.arange(-2.0, 2.0, 0.1))
    shelves = np.concatenate([np.column_stack((x.ravel(), y.ravel(), np.full(x.size, z))) for z in (1.0, 1.3)])
    result = result_of(sent("a", "b", extra=shelves))
    assert map_of(result) == {"a": 0, "b": 1}
    between = [closure for closure in result.closures if closure.i.robot != closure.j.robot]
    assert {closure.reason.code for closure in between} & {ReasonCode.IN_FREE_SPACE, ReasonCode.NOT_ENOUGH_EXPLAINED}
    assert all(closure.status is not ClosureStatus.ACCEPTED for closure in between)


def test_a_robot_in_space_has_no_place_in_a_mission_in_the_plane():
    cloud = Cloud(FleetConfig(), 0)
    with pytest.raises(PacketError, match="sends poses in space, but the mission is in the plane"):
        feed(cloud, sent("a"))


def test_another_library_reads_the_joint_map_with_normals_and_colours(tmp_path):
    result = result_of(sent("a", "b"))
    tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
    run = run_of(result, tracks, [], "", OccupancyConfig(), with_local_maps=False, with_certificates=False)
    (tmp_path / "map.ply").write_bytes(run.map_files["map.ply"])
    points, normals, colours = (rows[:, 0].astype(float) for rows in cv2.loadPointCloud(str(tmp_path / "map.ply")))
    assert len(points) == len(normals) == len(colours) > 1000
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=0.01)
    heights, upward = points[:, 2], normals[:, 2]
    is_floor = np.abs(upward) > 0.95
    low = np.median(heights[is_floor & (heights < 0.0)])
    assert low == pytest.approx(-BASE_M, abs=0.03), "the first base is the origin"
    assert heights.max() - low == pytest.approx(1.95, abs=0.15)
    faces_up = upward[is_floor & (heights < low + 0.2)] > 0.0
    assert np.mean(faces_up) > 0.98, "the floor faces the scanner; feet of walls lean"
    assert np.median(np.abs(upward[(heights > low + 0.5) & (heights < low + 1.5)])) < 0.1
    bright = colours[np.argsort(heights), 1]
    assert bright[: len(bright) // 10].mean() < bright[-len(bright) // 10 :].mean()


def test_a_run_in_space_keeps_its_six_degrees_of_freedom(tmp_path):
    recordings = Drive("a", ROUND, flat(), 0), Drive("b", BACK, flat(), 1)
    run = run_mission(recordings, MissionConfig(fleet=SPACE))
    run.save(tmp_path / "run")
    read = open_run(tmp_path / "run")
    for name, trajectory in run.trajectories.items():
        lines = np.loadtxt(tmp_path / "run" / "trajectories" / f"{name}.tum")
        np.testing.assert_allclose(lines[:, 1:], trajectory.T_map_base_6d, atol=1e-9)
        np.testing.assert_allclose(read.trajectories[name].T_map_base, trajectory.T_map_base, atol=1e-8)
    assert run.pose_graph_g2o.startswith("VERTEX_SE3:QUAT 0 ")
    assert {"map.pgm", "map.yaml", "map.png"} <= run.map_files.keys()
    assert "map.ply" not in run.map_files, "no robot sent a voxel map"
    again = run_mission([], MissionConfig(fleet=SPACE), inputs=MissionInputs(read_mission(tmp_path / "run")))
    for name, trajectory in run.trajectories.items():
        assert again.trajectories[name].T_map_base_6d.tobytes() == trajectory.T_map_base_6d.tobytes()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"T_base_ground": se3.from_plane((11.0, 0.0, 0.0))}, "floor 11 m off the base, at most 10 m"),
        ({"last": 4000}, "is of 4001 keyscans, at most 2000"),
        ({"last": 1900}, "names keyscan 1900"),
        ({}, "has a voxel map already"),
    ],
)
def test_a_voxel_map_beyond_a_limit_is_refused(change, reason):
    packets = [packet for packet in sent("a") if packet.robot == "a"]
    number = next(n for n, packet in enumerate(packets) if isinstance(packet.body, VoxelMap))
    cloud, known = Cloud(SPACE, 0), packets[: number + (not change)]
    feed(cloud, known)
    told = replace(packets[number], sequence=len(known), body=replace(packets[number].body, **change))
    with pytest.raises(PacketError, match=reason):
        cloud.receive(encode(told))
