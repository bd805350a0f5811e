"""Corrections move the robot in the map and never in its own frame."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2, se3
from fcslam.geometry.groups import compose
from fcslam.live.map_poses import CorrectedOdometry, MapPoses
from fcslam.records import Correction, Keyscan
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.wire.examples import CORRECTION


@pytest.fixture(scope="module")
def driven():
    """A robot's packets, and the track of its scans."""
    robot = small_fleet.draw(1, path_length_m=12.0).robots[0]
    frontend, packets = small_fleet.driven(robot.scans(), name=robot.name)
    return packets, frontend.scan_poses


def test_odom_is_where_the_cloud_thinks_it_is(driven):
    """The newest pose is the cloud's own, to the last digit that matters."""
    packets, track = driven
    cloud = Cloud(FleetConfig(), 0)
    newest = CorrectedOdometry(lambda: 0.0)
    for packet in packets:
        for body in (decode(data).body for data in cloud.receive(encode(packet))):
            if isinstance(body, Correction):
                newest.correct(body)
    keyscans = [packet.body for packet in packets if isinstance(packet.body, Keyscan)]
    (mapped,) = cloud.finalize().robots
    last = next(number for number, pose in enumerate(track) if pose.stamp == keyscans[-1].stamp)
    assert np.allclose(newest.T_map_base(track.T_odom_base()[last]), mapped.T_map_base[-1], atol=0.02)
    assert np.allclose(track.T_odom_base()[0], 0.0)


def test_a_correction_replaces_the_last_and_moves_every_pose(driven):
    poses = driven[1].T_odom_base()
    now = 0.0
    corrected = CorrectedOdometry(lambda: now)
    assert corrected.T_map_base(poses) is None
    assert corrected.map_index is corrected.age_s is None
    corrected.correct(CORRECTION)
    now = 3.0
    for stale in (CORRECTION.version, CORRECTION.version - 1):
        corrected.correct(replace(CORRECTION, version=stale, map_index=7, T_map_odom=np.zeros(3)))
    assert (corrected.map_index, corrected.age_s) == (CORRECTION.map_index, 3.0)
    T_map_odom = se2.compose(corrected.T_map_base(poses), se2.inverse(poses))
    assert np.allclose(se2.between(CORRECTION.T_map_odom, T_map_odom), 0.0, atol=1e-9)
    corrected.correct(replace(CORRECTION, version=CORRECTION.version + 1, map_index=2))
    assert (corrected.map_index, corrected.age_s) == (2, 0.0)


@pytest.mark.parametrize("is_away", [True, False])
def test_own_closures_move_the_pose_while_the_server_is_away(is_away):
    """And never the map. While the server is there, its next correction has the closure."""
    poses, here = MapPoses(lambda: 0.0), np.array([1.0, 2.0, 0.5])
    own = replace(CORRECTION, version=0, T_map_odom=np.zeros(3))
    poses.correct(0, own, is_server_away=False)
    poses.correct_by_server(0, replace(CORRECTION, map_index=1, T_map_odom=np.array([10.0, 0.0, 0.0])))
    before, T_map_own = poses.localizer(0).T_map_base(here), poses.T_map_own(0)
    poses.correct(0, replace(own, version=1, T_map_odom=np.array([-2.0, 0.0, 0.0])), is_away)
    assert np.allclose(poses.localizer(0).T_map_base(here) - before, [-2.0 * is_away, 0.0, 0.0])
    assert np.array_equal(poses.T_map_own(0), T_map_own)
    assert poses.localizer(0).map_index == 1
    assert poses.localizer(1).map_index is None, "another session has its own corrections"


def test_a_robot_with_a_2d_lidar_has_all_degrees_of_freedom_in_a_map_in_space(driven):
    """The server's map is in space, the robot's own in the plane."""
    odom, T_map_odom = driven[1].T_odom_base(), se3.exp((1.0, 2.0, 1.4, 0.02, -0.03, 0.5))
    poses = MapPoses(lambda: 0.0)
    poses.correct(0, CORRECTION, is_server_away=False)
    assert poses.localizer(0).T_map_base(odom).shape == odom.shape
    poses.correct_by_server(0, replace(CORRECTION, version=9, T_map_odom=T_map_odom))
    found = poses.localizer(0).T_map_base(odom)
    assert np.allclose(found, se3.compose(T_map_odom, se3.from_plane(odom)))
    by_own = compose(poses.T_map_own(0), se2.compose(CORRECTION.T_map_odom, odom))
    assert np.allclose(by_own, found), "both maps put the robot at the same place"
    moved = replace(
        CORRECTION, version=CORRECTION.version + 1, T_map_odom=se2.compose(CORRECTION.T_map_odom, (0.1, 0, 0))
    )
    poses.correct(0, moved, is_server_away=True)
    step = se3.between(found, poses.localizer(0).T_map_base(odom))
    assert np.allclose(np.linalg.norm(step[:, :3], axis=1), 0.1), "while the server is away, its own map counts"
