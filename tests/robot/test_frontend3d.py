"""The front end of a robot with a 3D LiDAR: packets that the wire accepts, tracks, closures and sessions."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2, se3
from fcslam.lidar3d import tracker
from fcslam.live.records import Wiring
from fcslam.live.robot import Robot
from fcslam.records import CloudScan, Constraint, ConstraintKind, Keyscan, Place, VoxelMap
from fcslam.robot.backend import SessionConfig
from fcslam.robot.frontend import RobotConfig
from fcslam.robot.frontend3d import RobotFrontend3d
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode, encode
from tests.live.same_thread import SameThread
from tests.spinning_lidar import PERIOD_S, circle, drive, room


def driven_by(scans: Iterable[CloudScan], **config: object) -> tuple[RobotFrontend3d, list]:
    """The front end of a robot after its last turn, and its packets so far."""
    robot = RobotFrontend3d("anna", SessionConfig(**config))
    return robot, [packet for scan in scans for packet in robot.process(scan)]


@pytest.fixture(scope="module")
def driven() -> tuple[RobotFrontend3d, list, np.ndarray]:
    turns = list(drive(room(1), circle((6.0, 4.0), 1.6, 0.8), 130, azimuths=120))
    robot, packets = driven_by(scan for scan, _ in turns)
    return robot, [*packets, *robot.finish()], np.array([pose for _, pose in turns])


def test_packets_pass_the_wire_in_order(driven: tuple) -> None:
    _, packets, _ = driven
    assert [packet.sequence for packet in packets] == list(range(len(packets)))
    assert isinstance(packets[0].body, Hello)
    kinds = Counter(type(decode(encode(packet)).body) for packet in packets)
    assert kinds[Keyscan] > 20
    assert kinds[VoxelMap] == kinds[Place] > 3


def test_motions_are_right_and_their_information_is_honest(driven: tuple) -> None:
    robot, packets, truth = driven
    stamps = {packet.body.id.number: packet.body.stamp for packet in packets if isinstance(packet.body, Keyscan)}
    poses = {number: truth[np.searchsorted(robot.scan_poses.stamps, stamp)] for number, stamp in stamps.items()}
    motions = [packet.body for packet in packets if isinstance(packet.body, Constraint)]
    assert {motion.kind for motion in motions} == set(ConstraintKind)
    errors = np.array([se3.log(se3.between(m.T_i_j, se3.between(poses[m.i], poses[m.j]))) for m in motions])
    assert np.abs(errors[:, :3]).max() < 0.03
    chi2 = [error @ motion.information @ error for error, motion in zip(errors, motions, strict=True)]
    assert np.median(chi2) < 12.0
    found = se3.between(truth[0], truth)
    assert np.abs(se3.log(se3.between(found, robot.scan_poses.T_odom_base()))[:, :3]).max() < 0.04


def test_a_local_map_is_level_and_its_floor_is_at_zero(driven: tuple) -> None:
    _, packets, _ = driven
    local = next(packet.body for packet in packets if isinstance(packet.body, VoxelMap))
    heights = local.points_m[:, 2]
    assert np.median(heights[np.abs(heights) < 0.2]) == pytest.approx(0.0, abs=0.03)
    assert heights.max() == pytest.approx(3.0, abs=0.1)
    assert local.T_base_ground == pytest.approx(se3.IDENTITY, abs=0.02)


def test_keyscans_show_walls_where_they_are(driven: tuple) -> None:
    _, packets, _ = driven
    lasers = packets[0].body.lasers
    scan = next(packet.body for packet in packets if isinstance(packet.body, Keyscan))
    seen = scan.ranges_m > 0.0
    angles = lasers[0].angles_rad()[seen] + np.pi / 2.0
    x, y = 7.6 + scan.ranges_m[seen] * np.cos(angles), 4.0 + scan.ranges_m[seen] * np.sin(angles)
    near = np.min([np.abs(x), np.abs(x - 12.0), np.abs(y), np.abs(y - 8.0)], axis=0)
    assert seen.mean() > 0.3
    assert np.median(near) < 0.1


@pytest.mark.parametrize(
    ("lidar", "is_left_out"),
    [
        ({}, False),
        ({"footprint": [[-0.7, -0.2], [-0.5, -0.2], [-0.5, 0.2], [-0.7, 0.2]]}, True),
        ({"ignore": [[170.0, -170.0]]}, True),
    ],
)
def test_the_robot_itself_is_left_out(lidar: dict, is_left_out: bool) -> None:
    mast, now = np.column_stack((np.full(40, -0.6), np.zeros(40), np.linspace(0.2, 1.0, 40))), np.zeros(40, np.float32)
    robot, _ = driven_by(
        (
            replace(scan, points_m=np.vstack((scan.points_m, np.float32(mast))), times_s=np.append(scan.times_s, now))
            for scan, _ in drive(room(1), circle((6.0, 4.0), 1.6, 0.8), 12, azimuths=120)
        ),
        lidar=lidar,
    )
    keyframe, _ = robot.mapped
    assert (np.hypot(keyframe.points[:, 0] + 0.6, keyframe.points[:, 1]) > 0.15).all() == is_left_out


def test_settings_without_effect_are_named() -> None:
    assert not RobotConfig(lidar={"footprint": [[0, 0], [1, 0], [1, 1]]}, channels=["lidar"]).unused_in_space
    config = {"fleet": {"dimensions": 3}, "robot": {"lidar": {"tracker": "karto"}, "tags": {"size_m": 0.2}}}
    with Robot("anna", lidar_3d=True, config=config, wiring=Wiring(SameThread())) as robot:
        (notice,) = robot.status().notices
    assert notice == "robot.lidar.tracker, robot.tags: only robots with 2D LiDARs use these settings"


def later(scan: CloudScan, shift_s: float, ahead_m: float = 0.0) -> CloudScan:
    """The turn with other stamps, and wheels that are farther on along x."""
    return replace(scan, stamp=scan.stamp + shift_s, wheels=scan.wheels + np.array([shift_s, ahead_m, 0.0, 0.0]))


def test_a_clock_that_steps_back_begins_a_session() -> None:
    turns = list(drive(room(1), circle((6.0, 4.0), 0.8, 0.2), 4))
    robot, packets = driven_by(later(scan, shift_s) for shift_s in (1000.0, 0.0) for scan, _ in turns)
    packets += robot.finish()
    assert [len(track) for track in robot.tracks] == [4, 4]
    assert [packet.epoch for packet in packets if isinstance(packet.body, Hello)] == [0, 1]


@pytest.mark.parametrize(("put_down_in", "sessions"), [(1, 1), (2, 2)])
def test_a_robot_is_lost_in_another_room_and_not_where_more_points_miss_their_surface(
    monkeypatch: pytest.MonkeyPatch, put_down_in: int, sessions: int
) -> None:
    def turns(seed: int, count: int) -> list[CloudScan]:
        there = drive(room(seed, (12.0, 8.0 * seed)), circle((6.0, 4.0), 0.8, 0.4), count, azimuths=120)
        return [scan for scan, _ in there]

    monkeypatch.setattr(tracker, "_POOR_LEAST", -1.0 if put_down_in == 1 else tracker._POOR_LEAST)
    robot, _ = driven_by([*turns(1, 40), *turns(put_down_in, 90)[40:]])
    assert len(robot.tracks) == sessions


@pytest.mark.parametrize(("moved_m", "scans"), [(0.0, [8]), (17.0, [4, 4])])
def test_a_robot_that_drove_far_while_its_lidar_paused_begins_a_session(moved_m: float, scans: list[int]) -> None:
    turns = [scan for scan, _ in drive(room(1), circle((6.0, 4.0), 0.8, 0.2), 8)]
    robot, packets = driven_by([*turns[:4], *(later(scan, 24.0, moved_m) for scan in turns[4:])])
    packets += robot.finish()
    assert [len(track) for track in robot.tracks] == scans
    assert not [packet for packet in packets if isinstance(packet.body, Constraint)], "nobody saw the way"


@pytest.fixture(scope="module")
def straight() -> list:
    return list(drive(room(1), path, 60, azimuths=120))


def path(t: float) -> np.ndarray:
    return np.array([2.0 + t, 4.0 + 0.1 * np.sin(t), 0.1 * np.cos(t)])


@pytest.mark.parametrize("wheels", [True, False])
@pytest.mark.parametrize("late", [0.0, 0.5, 1.0])
def test_the_first_motion_is_right_wherever_in_a_turn_its_stamp_is(wheels: bool, late: float) -> None:
    robot, packets = driven_by(
        replace(
            scan,
            stamp=scan.stamp + late * PERIOD_S,
            times_s=scan.times_s - np.float32(late * PERIOD_S),
            wheels=scan.wheels[: wheels * len(scan.wheels)],
        )
        for scan, _ in drive(room(1), path, 8, azimuths=240)
    )
    assert robot.scan_poses.T_odom_base()[0] == pytest.approx(se3.IDENTITY, abs=1e-6)
    first = next(packet.body for packet in packets if isinstance(packet.body, Constraint))
    stamps = [packet.body.stamp for packet in packets if isinstance(packet.body, Keyscan)]
    poses = np.array([se3.from_plane(path(stamp)) for stamp in stamps[:2]])
    error = se3.log(se3.between(first.T_i_j, se3.between(*poses)))
    assert np.abs(error[:2]).max() < 0.02


def jump(by: tuple[float, float, float]) -> Callable[[np.ndarray], np.ndarray]:
    """Wheels that go on elsewhere after 2.55 s, with the robot moved by so much."""
    at = np.array([4.55, 4.06, -0.08])
    T = se2.compose(se2.compose(at, by), se2.inverse(at))
    return lambda read: np.where(read[:, :1] > 2.55, se2.compose(T, read[:, 1:]), read[:, 1:])


def frozen(since_s: float) -> Callable[[np.ndarray], np.ndarray]:
    """Wheels that stand still from a time on."""
    return lambda read: np.where(read[:, :1] > since_s, (2.0 + since_s, 4.0, 0.1), read[:, 1:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wheels", "jumps"),
    [
        *((jump((by_m, 0.0, 0.0)), int(abs(by_m) > 1.5)) for by_m in (0.3, 0.5, -1.0, 2.0, 5.0, -50.0)),
        (jump((0.0, 0.0, 0.3)), 0),
        (jump((3.0, -2.0, 2.5)), 1),
        (frozen(0.0), 0),
        (frozen(2.5), 0),
    ],
)
def test_the_path_is_right_though_the_odometry_jumps_or_stands(
    straight: list, wheels: Callable[[np.ndarray], np.ndarray], jumps: int
) -> None:
    robot, _ = driven_by(
        replace(scan, wheels=np.column_stack((scan.wheels[:, 0], wheels(scan.wheels)))) for scan, _ in straight
    )
    assert len(robot.tracks) == 1
    assert robot.jumps == jumps
    truth = np.array([pose for _, pose in straight])
    found = robot.scan_poses.T_odom_base()
    assert np.abs(se3.log(se3.between(se3.between(truth[0], truth), found))[:, :3]).max() < 0.1


def test_wheels_that_stand_while_the_clouds_change_are_named(straight: list) -> None:
    standing = np.array([1.0, 0.0, 0.0, 0.0])
    robot, _ = driven_by(replace(scan, wheels=scan.wheels * standing) for scan, _ in straight[::3])
    assert robot.odometry_fault == "never changes in 19 poses"
    assert robot.lacks_odometry
