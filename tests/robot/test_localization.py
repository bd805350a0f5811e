"""Corrections move the robot in the map and never in its own frame."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.records import Constraint, ConstraintKind, Correction, Keyscan
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.localization import Localizer
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.wire.examples import CORRECTION


@pytest.fixture(scope="module")
def driven():
    """A robot's packets, its localizer without corrections, and its scans' poses on keyscans."""
    robot = small_fleet.draw(1, path_length_m=12.0).robots[0]
    frontend, localizer = RobotFrontend(robot.name, RobotConfig()), Localizer(lambda: 0.0)
    packets = [packet for scan in robot.scans() for packet in frontend.process(scan)]
    for body in (packet.body for packet in packets):
        if isinstance(body, Constraint) and body.kind is ConstraintKind.ODOMETRY:
            localizer.extend(body)
    return packets, localizer, frontend.scan_poses


def test_odom_is_where_the_cloud_thinks_it_is(driven):
    """The newest pose is the cloud's own, to the last digit that matters."""
    packets, localizer, poses = driven
    cloud = Cloud(FleetConfig(), 0)
    newest = Localizer(lambda: 0.0)
    for packet in packets:
        for body in (decode(data).body for data in cloud.receive(encode(packet))):
            if isinstance(body, Correction):
                newest.correct(body)
    keyscans = [packet.body for packet in packets if isinstance(packet.body, Keyscan)]
    (mapped,) = cloud.finalize().robots
    last = next(pose for pose in poses if pose.stamp == keyscans[-1].stamp)
    for motion in (
        p.body for p in packets if isinstance(p.body, Constraint) and p.body.kind is ConstraintKind.ODOMETRY
    ):
        newest.extend(motion)
    assert np.allclose(newest.T_map_base(last), mapped.T_map_base[-1], atol=0.02)
    assert np.allclose(localizer.T_odom_base(poses[0]), 0.0)


def test_a_correction_replaces_the_last_and_leaves_odom_alone(driven):
    _, localizer, poses = driven
    before = [localizer.T_odom_base(pose) for pose in poses]
    assert localizer.T_map_base(poses[0]) is None
    assert localizer.map_index is localizer.age_s is None
    now = 0.0
    corrected = Localizer(lambda: now)
    corrected._T_odom_keyscan = localizer._T_odom_keyscan
    corrected.correct(CORRECTION)
    now = 3.0
    for stale in (CORRECTION.version, CORRECTION.version - 1):
        corrected.correct(replace(CORRECTION, version=stale, map_index=7, T_map_odom=np.zeros(3)))
    assert (corrected.map_index, corrected.age_s) == (CORRECTION.map_index, 3.0)
    for pose, T_odom_base in zip(poses, before, strict=True):
        assert np.array_equal(corrected.T_odom_base(pose), T_odom_base)
        T_map_odom = se2.compose(corrected.T_map_base(pose), se2.inverse(T_odom_base))
        assert np.allclose(se2.between(CORRECTION.T_map_odom, T_map_odom), 0.0, atol=1e-9)
    corrected.correct(replace(CORRECTION, version=CORRECTION.version + 1, map_index=2))
    assert (corrected.map_index, corrected.age_s) == (2, 0.0)
