"""A robot with drifting odometry stays where it is in the buffer of what it saw."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.odometry import WHEELS, odometry_error
from fcslam.lidar.tracker import ScanTracker
from fcslam.records import LaserModel, frozen
from tests.lidar.worlds import (
    LASER,
    box,
    chain,
    corridor,
    drifting,
    drive,
    path,
    pose_errors,
    recording,
    ring,
    ring_drive,
    shifted,
)

KEYSCAN_M, KEYSCAN_RAD = 0.25, 0.25


def track(scans):
    """Poses of every scan; what moved on enough goes into the buffer, as the mapper does it."""
    tracker = ScanTracker(WHEELS)
    poses, last = [], None
    for scan in scans:
        tracker.commit(result := tracker.localize(scan))
        tracked = result.tracked
        poses.append(tracked.T_local_base)
        motion = np.full(3, np.inf) if last is None else se2.between(last, tracked.T_local_base)
        if tracked.scan is not None and (np.hypot(motion[0], motion[1]) > KEYSCAN_M or abs(motion[2]) > KEYSCAN_RAD):
            tracker.insert(tracked.scan, tracked.T_local_base)
            last = tracked.T_local_base
    return np.array(poses), tracker


def slipped(odometry, at, motion):
    """The odometry with one step that did not happen."""
    motions = se2.relative(odometry)
    motions[at] = se2.compose(motions[at], motion)
    return chain(motions, odometry[0])


def assert_followed(found, truth, most_m=0.10, most_deg=1.0):
    shift, turn = pose_errors(found, truth)
    assert shift.max() < most_m
    assert np.rad2deg(turn.max()) < most_deg


@pytest.fixture(scope="module")
def truth():
    return ring_drive()


@pytest.fixture(scope="module")
def odometry(truth):
    return drifting(truth, np.random.default_rng(1))


@pytest.mark.slow
@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.3, 0.1, 0.4)])
def test_a_drive_of_fifty_metres_is_tracked(truth, odometry, mount):
    laser = replace(LASER, T_base_laser=mount)
    poses, _ = track(recording(truth, odometry, ring(), laser))
    assert pose_errors(odometry, truth)[0].max() > 2.0
    assert_followed(poses, truth)


@pytest.mark.slow
@pytest.mark.parametrize("slip", [(0.5, 0.0, np.deg2rad(15)), (-0.35, 0.35, np.deg2rad(-15)), (0.0, -0.5, 0.0)])
def test_a_slip_is_recovered(truth, odometry, slip):
    scans = recording(truth, slipped(odometry, 200, slip), ring())[:260]
    shift, turn = pose_errors(track(scans)[0], truth[:260])
    assert shift[201:].max() < 0.05
    assert np.rad2deg(turn[201:].max()) < 0.5


def true_steps(truth, rng, noise_m=0.002, noise_rad=0.001):
    """Odometry (N, 3) that is right to a few millimetres a step."""
    return chain(se2.relative(truth) + rng.normal(size=(len(truth) - 1, 3)) * (noise_m, noise_m, noise_rad))


def yard(moved=(0.0, 0.0)):
    """A wall with recesses on one side; on the other a row of parked trucks, all of which may have moved on."""
    wall = path(*[(x + dx, -4.0 - dy) for x in range(-8, 9, 4) for dx, dy in ((0, 0), (1.5, 0), (1.5, 1), (2.5, 1))])
    trucks = [box(x, 3.0, x + 2.4, 4.5) for x in (-11.0, -7.2, -4.0, 0.3, 3.4, 7.0, 11.1, 14.4)]
    return np.vstack((wall, *(shifted(truck, *moved) for truck in trucks)))


@pytest.mark.parametrize(("moved", "most_wrong"), [((0.6, 0.4), 4), ((0.4, 0.4), 0)])
def test_right_odometry_is_not_overruled_by_what_moved(moved, most_wrong):
    """After the change most of what is seen fits better where the robot is not; a small move never misleads."""
    truth = drive([(-4.0, 1.2), (4.0, 1.2)])
    wrong = 0
    for seed in range(6):
        odometry = true_steps(truth, np.random.default_rng(seed))
        scans = recording(truth, odometry, yard(), seed=seed)
        scans[-1] = recording(truth[-1:], odometry[-1:], yard(moved), seed=seed + 9)[0]
        shift, turn = pose_errors(track(scans)[0], truth)
        wrong += shift.max() >= 0.10 or np.rad2deg(turn.max()) >= 1.0
    assert wrong <= most_wrong


@pytest.mark.parametrize("slip", [(0.7, 0.0, 0.0), (-0.4, 0.0, np.deg2rad(10)), (0.0, 0.3, np.deg2rad(-6))])
def test_odometry_that_was_right_is_overruled_by_a_clear_scan(slip):
    truth = drive([(-4.0, 1.2), (4.0, 1.2)])
    odometry = slipped(true_steps(truth, np.random.default_rng(5)), 60, slip)
    assert_followed(track(recording(truth, odometry, yard()))[0], truth)


def posts(seed):
    """Posts before a far wall."""
    rng = np.random.default_rng(seed)
    corners = zip(rng.uniform(-8, 12, 14), rng.uniform(-5, 6, 14), strict=True)
    return np.vstack(
        (path((-30, 12), (30, 12)), *(box(x, y, x + 0.3, y + 0.3) for x, y in corners if abs(y - 1.2) > 0.8))
    )


@pytest.mark.parametrize("slip", [(0.7, 0.0, 0.0), (-0.7, 0.0, np.deg2rad(2))])
def test_a_slip_is_found_although_a_wrong_match_explains_what_is_known(slip):
    """The far wall fits at the wrong pose too; after a long step, the tracker compares other poses."""
    laser = LaserModel(361, -0.5 * np.pi, np.pi / 360, 30.0)
    truth = drive([(-4.0, 1.2), (4.0, 1.2)])
    odometry = slipped(true_steps(truth, np.random.default_rng(5)), 50, slip)
    assert_followed(track(recording(truth, odometry, posts(4), laser))[0], truth)


@pytest.mark.slow
def test_a_blind_stretch_is_bridged_by_odometry_with_its_learned_scale(truth):
    odometry = drifting(truth, np.random.default_rng(2), scale=1.05, veer_rad_m=0.03)
    blind = range(150, 190)
    scans = [
        replace(scan, ranges_m=frozen(np.full(360, LASER.max_range_m), np.float32)) if k in blind else scan
        for k, scan in enumerate(recording(truth, odometry, ring())[:250])
    ]
    poses, tracker = track(scans)
    assert tracker.trust.distance.value == pytest.approx(1.0 / 1.05, abs=0.005)
    travels = [np.hypot(*se2.relative(by)[150:189, :2].T).sum() for by in (poses, odometry, truth)]
    assert travels[0] == pytest.approx(travels[2], rel=0.005)
    assert travels[1] > 1.04 * travels[2]
    assert pose_errors(poses, truth[:250])[0][195:].max() < 0.10


@pytest.mark.parametrize("beams", [180, 360])
@pytest.mark.parametrize("step_m", [0.1, 0.25])
def test_a_bare_corridor_leaves_the_way_along_it_to_odometry(beams, step_m):
    """Nothing tells how far the robot went but its wheels: the pattern of the beams on the walls must not."""
    laser = LaserModel(beams, -0.5 * np.deg2rad(beams), np.deg2rad(1.0), 20.0)
    truth = drive([(-10, 0), (5, 0)], step_m=step_m)
    poses, _ = track(recording(truth, se2.between(truth[0], truth), corridor(), laser, noise_m=0.01))
    assert_followed(poses, truth, 0.6, 0.5)


def test_a_standing_robot_stands(truth):
    poses = np.repeat(truth[50:51], 20, axis=0)
    found, _ = track(recording(poses, np.zeros((20, 3)), ring(), noise_m=0.02))
    np.testing.assert_array_equal(found, np.zeros((20, 3)))


@pytest.mark.slow
def test_somebody_who_walks_by_does_not_take_the_robot_along(truth, odometry):
    """A legs-sized box keeps pace with the robot for 10 m."""
    scans = []
    for k, scan in enumerate(recording(truth, odometry, ring())[:200]):
        x, y = se2.transform(truth[k], np.array([[0.8, 0.5]]))[0]
        walls = np.vstack((ring(), box(x - 0.15, y - 0.15, x + 0.15, y + 0.15)))
        scans.append(recording(truth[k : k + 1], odometry[k : k + 1], walls, seed=k)[0])
        scans[-1] = replace(scans[-1], stamp=scan.stamp)
    shift, _ = pose_errors(track(scans)[0], truth[:200])
    assert shift.max() < 0.10


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_the_learned_error_of_odometry_is_its_true_error(truth, share):
    """The normalised innovation is about 1: trust is neither too high nor too low."""
    poses = truth[:250]
    rng, steps = np.random.default_rng(4), se2.relative(poses)
    model = [odometry_error(np.hypot(x, y), abs(turn), WHEELS) for x, y, turn in steps.tolist()]
    sigmas = np.array([(error.position_m, error.position_m, error.heading_rad) for error in model])
    errors = share * sigmas * rng.standard_normal(steps.shape)
    _, tracker = track(recording(poses, chain(se2.compose(steps, errors)), ring()))
    learned = [tracker.trust.scale(error) for error in model]
    normalised = [error.mahalanobis2(e) / 3.0 for error, e in zip(learned, errors, strict=True)]
    assert 0.5 < np.sqrt(np.mean(normalised)) < 2.0


@pytest.mark.parametrize("error_m", [0.15, 0.25, -0.2, -0.25])
def test_a_long_step_beside_a_fence_ends_at_the_right_post(error_m):
    """Posts 0.4 m apart attract a match that starts nearer to the next one."""
    posts = [box(x, y, x + 0.05, y + 0.05) for x in np.arange(-5.0, 12.0, 0.4) for y in (-2.5, 2.5)]
    truth = np.array([(0.0, 0.0, 0.0), (1.03, 0.1, 0.1)])
    odometry = truth + np.array([(0.0, 0.0, 0.0), (error_m, 0.05, 0.03)])
    shift, turn = pose_errors(track(recording(truth, odometry, np.vstack(posts)))[0], truth)
    assert shift[1] < 0.02
    assert turn[1] < 0.005
