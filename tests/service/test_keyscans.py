"""A robot's newest pose and scan come from its packets, whatever the map shows."""

import numpy as np
import pytest

from fcslam.geometry import se2, se3
from fcslam.mission.mission_file import as_stored
from fcslam.mission.mission_store import MissionStore
from fcslam.runs import RobotTrajectory
from fcslam.service.keyscans import live_pose, live_scan
from fcslam.wire.packets import decode, measure
from fcslam.wire.quantisation import dequantise
from tests.scripted import LASER
from tests.service.http.desk import POSES, A

POSES_M = np.array(POSES)
T_new_map = np.array((3.0, -2.0, 0.7))


@pytest.fixture
def store(tmp_path):
    store = MissionStore(tmp_path / "mission.sqlite")
    store.put([as_stored(measure(decode(data))) for data in A], 0.0)
    yield store
    store.close()


@pytest.mark.parametrize("drawn", [1, len(POSES) // 2, len(POSES)])
def test_a_pose_is_the_drawn_one_moved_by_what_the_robot_drove_since(store, drawn):
    in_map = np.array([se2.compose(T_new_map, pose) for pose in POSES_M])
    trajectory = RobotTrajectory("a", 0, np.arange(float(drawn)), in_map[:drawn])
    assert live_pose(store, "a", 0, trajectory) == pytest.approx(in_map[-1], abs=0.02)


def test_a_robot_that_drives_on_a_floor_keeps_its_height_in_a_map_in_space(store):
    T_map_odom = se3.compose((3.0, -2.0, 1.4, 0.0, 0.0, 0.0, 1.0), se3.from_plane((0.0, 0.0, 0.7)))
    in_map = se3.compose(T_map_odom, se3.from_plane(POSES_M))
    trajectory = RobotTrajectory("a", 0, np.arange(3.0), se3.to_plane(in_map)[:3], T_map_base_6d=in_map[:3])
    assert live_pose(store, "a", 0, trajectory) == pytest.approx(in_map[-1], abs=0.02)


def test_a_session_without_packets_stays_where_it_was_drawn_and_sees_nothing(store):
    trajectory = RobotTrajectory("z", 0, np.arange(2.0), POSES_M[:2])
    assert live_pose(store, "z", 0, trajectory) == pytest.approx(POSES_M[1])
    assert len(live_scan(store, "z", 0)) == 0


@pytest.mark.parametrize("at_s", [-5.0, 0.0, 7.4, 7.6, 99.0])
def test_keyscans_and_motions_are_those_of_a_time(store, at_s):
    stamps = np.arange(float(len(POSES)))
    nearest = stamps[np.argsort(abs(stamps - at_s), kind="stable")[:4]]
    assert [keyscan.stamp for keyscan in store.keyscans_near("a", 0, at_s, 4)] == nearest.tolist()
    assert len(store.constraints_since("a", 0, at_s)) == np.sum(stamps[1:] >= at_s)


def test_the_scan_is_the_newest_one(store):
    (newest,) = {*dequantise(np.full(1, 1000 + len(POSES) - 1, np.uint16)).tolist()}  # as ``tests.scripted`` draws it
    points = live_scan(store, "a", 0)
    assert len(points) == LASER.beam_count
    assert np.hypot(*points.T) == pytest.approx(newest)
