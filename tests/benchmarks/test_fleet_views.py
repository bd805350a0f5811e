"""The images of a simulated fleet as places: which are taken, and what two of them show in common, against geometry."""

import cv2
import numpy as np
import pytest
from evaluation.fleet_views import MatchViews, judge_views, lidar_overlap, read_fleet_views
from evaluation.place_sets import read_place_set

from fcslam.geometry import se2
from fcslam.records import (
    CameraImage,
    CameraModel,
    Channel,
    ClosureStatus,
    LaserModel,
    LaserScan,
    Reason,
    ReasonCode,
    Transform,
    frozen,
)
from fcslam.runs import ClosureRow, RobotTrajectory, Run, read_tum, write_tum
from fcslam.sources import write_bag
from tests.lidar.worlds import cast

LASER = LaserModel(360, -np.pi, 2.0 * np.pi / 360, 30.0)
CAMERA = CameraModel(64, 48, 40.0, 40.0, 31.5, 23.5, Transform((0.0, 0.0, 0.5), (-0.5, 0.5, -0.5, 0.5)))
HALF_VIEW_RAD = float(np.arctan2(32.0, 40.0))
WALLS = np.array([[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0], [4, 0, 4, 4]], float)
"""Of a room of 8 m by 6 m with a wall that stands into it, by both ends."""


def ranges_from(pose):
    return cast(pose[:2], pose[2] + LASER.angles_rad(), WALLS)


def overlap_oracle(a, b):
    """Of what stands ahead of a, the share that nothing hides from b, in the field of view of b."""
    angles = a[2] + np.linspace(-HALF_VIEW_RAD, HALF_VIEW_RAD, 400)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    away = a[:2] + cast(a[:2], angles, WALLS)[:, None] * directions - b[:2]
    headings = np.arctan2(away[:, 1], away[:, 0])
    in_view = np.abs(se2.wrap_angle(headings - b[2])) <= HALF_VIEW_RAD
    free = cast(b[:2], headings, WALLS) >= np.hypot(*away.T) - 1e-6
    return (in_view & free).mean()


def test_overlap_is_what_two_poses_see_of_the_same_walls():
    rng = np.random.default_rng(0)
    poses = np.column_stack((rng.uniform([0.5, 0.5], [7.5, 5.5], (14, 2)), rng.uniform(-np.pi, np.pi, 14)))
    poses[1] = poses[0] + (0.2, -0.1, 0.1)
    poses[2], poses[3] = (3.5, 2.0, 0.0), (4.5, 2.0, 0.0)  # near, equal, and a wall in between
    overlap = lidar_overlap(poses, np.array([ranges_from(pose) for pose in poses]), LASER, HALF_VIEW_RAD)
    expected = np.array([[min(overlap_oracle(a, b), overlap_oracle(b, a)) for b in poses] for a in poses])
    np.testing.assert_allclose(overlap, expected, atol=0.08)
    np.testing.assert_allclose(np.diag(overlap), 1.0)
    assert overlap[2, 3] == 0.0
    assert (expected > 0.5).sum() > 16
    assert (expected < 0.1).sum() > 50


def record(folder, poses, camera=CAMERA):
    """A scan and an image at each pose; a first image before any scan, and a last pose without an image."""
    picture = cv2.imencode(".png", np.zeros((CAMERA.height, CAMERA.width), np.uint8))[1].tobytes()
    records = []
    for k, pose in enumerate(poses):
        if camera is not None and k < len(poses) - 1:
            records.append(CameraImage(0.1 * k, picture, camera, None))
        records.append(LaserScan(0.1 * k, frozen(ranges_from(pose), np.float32), LASER, frozen(np.zeros(3))))
    write_bag(folder, records)
    write_tum(folder / "ground_truth.tum", 0.1 * np.arange(len(poses)), np.array(poses))
    return folder


@pytest.fixture
def fleet(tmp_path):
    """Two robots on one way, the second one further on and back again."""
    there = np.column_stack((0.6 + 0.101 * np.arange(28), np.full(28, 5.0), np.zeros(28)))
    turn = np.column_stack((np.full(32, 3.3), np.full(32, 5.0), np.arange(0.1, 3.25, 0.1)))
    record(tmp_path / "a", there)
    record(tmp_path / "b", np.concatenate((there, turn)))
    (tmp_path / "simulation.yaml").write_text("seed: 1\n", encoding="utf-8")
    return tmp_path


def test_places_are_the_images_that_are_new(fleet):
    views = read_fleet_views(fleet)
    names = {robot: [int(path.stem) for path in views.images if path.parts[-2] == robot] for robot in "ab"}
    assert names["a"] == [1, 11, 21]  # a metre apart; the image before the first scan has no pose
    assert names["b"][:3] == names["a"]
    steps = np.diff(names["b"][3:])
    assert len(steps) >= 4
    assert ((steps == 5) | (steps == 6)).all()  # half a radian apart
    assert views.robots.tolist() == [0] * 3 + [1] * len(names["b"])
    assert np.diag(views.overlap[:3, 3:6]) == pytest.approx(1.0)


def test_a_fleet_is_a_set_of_places_between_robots(fleet):
    found = read_place_set(fleet)
    (truth,) = found.questions.values()
    assert {path.parts[-2] for path in found.queries} == {"b"}
    assert {path.parts[-2] for path in found.gallery} == {"a"}
    assert found.admitted.all()
    assert np.diag(truth.matches[:3]).all()
    assert not truth.matches[-1].any()  # the other way
    assert truth.different[-1].any()
    assert not (truth.matches & truth.different).any()


def views_of_matches(fleet, *matches):
    """The counts of a run of ``fleet`` whose closures join these images of a and b, of a status each."""
    trajectories, closures = {}, []
    for robot in "ab":
        stamps, poses = read_tum(fleet / robot / "ground_truth.tum")
        trajectories[robot] = RobotTrajectory(robot, 0, stamps, poses)
    for i, j, status in matches:
        ends = "a", float(trajectories["a"].stamps[i]), "b", float(trajectories["b"].stamps[j])
        closures.append(
            ClosureRow(*ends, Channel.CAMERA, 0.5, frozen(np.zeros(3)), status, Reason(ReasonCode.VERIFIED))
        )
    run = Run(trajectories, closures=tuple(closures))
    run.save(fleet / "run")
    return judge_views(fleet / "run", fleet)


def test_matches_are_judged_by_what_both_cameras_see(fleet):
    """The third is of one position and opposite headings, the fourth of positions two metres apart."""
    accepted, candidate = ClosureStatus.ACCEPTED, ClosureStatus.CANDIDATE
    matches = (5, 5, accepted), (5, 7, candidate), (27, 58, accepted), (3, 23, candidate)
    views = views_of_matches(fleet, *matches)
    assert views[accepted] == MatchViews(same=1, different=1, judged=2)
    assert views[candidate].judged == 4
    assert views[candidate].same >= 2
