"""A robot in a finished map in space: with a 3D LiDAR or a 2D one, on its floor, and in no other building."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import SourceError
from fcslam.geometry import se2, se3
from fcslam.maps.joint_voxels import ply_of, read_points
from fcslam.mission.localization import read_finished, run_localization
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import KeyscanId, LaserModel, LaserScan, VoxelMap
from fcslam.robot.space_localizer import SpaceMap
from fcslam.runs import open_run
from tests.flats import Recording
from tests.sources.bag_messages import save
from tests.sources.test_clouds_in_space import drive as drive_elsewhere
from tests.spinning_lidar import cast, circle, drive, room

pytestmark = pytest.mark.slow

LASER = LaserModel(360, -np.pi, 2.0 * np.pi / 360, 30.0)
FIRST = circle((6.0, 4.0), 1.6, 0.8)
OTHER = circle((6.3, 3.8), 2.2, -0.4)


def clouds(building, pose_at, turns, **options):
    return [scan for scan, _ in drive(room(building), pose_at, turns, azimuths=120, **options)]


def scans(pose_at, count):
    """Of a 2D laser 0.3 m above the floor."""
    rays = np.column_stack((np.cos(LASER.angles_rad()), np.sin(LASER.angles_rad()), np.zeros(360)))
    for number in range(count):
        pose = se3.from_plane(pose_at(0.1 * number))
        origin = se3.transform(pose, np.array([[0.0, 0.0, 0.3]]))
        ranges = cast(room(1), np.repeat(origin, 360, axis=0), rays @ se3.rotation(pose).T)
        yield LaserScan(
            0.1 * number, ranges.astype(np.float32), LASER, se2.between(pose_at(0.0), pose_at(0.1 * number))
        )


def errors(run, pose_at):
    """Distance (m) and turn (rad) of the believed poses from the truth, in six degrees of freedom."""
    (trajectory,) = run.trajectories.values()
    truth = se3.from_plane(np.array([pose_at(stamp) for stamp in trajectory.stamps]))
    T_map_building = se3.inverse(se3.from_plane(FIRST(0.0)))
    off = se3.log(se3.between(se3.compose(T_map_building, truth), trajectory.T_map_base_6d))
    return np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    run = run_mission([Recording(clouds(1, FIRST, 130), "anna")], MissionConfig(fleet=FleetConfig(dimensions=3)))
    place = tmp_path_factory.mktemp("finished") / "run"
    run.save(place)
    return place


@pytest.fixture(scope="module")
def finished(folder):
    return read_finished(folder)


def localized(records, finished, **options):
    return run_localization(Recording(records, "carol"), finished, MissionConfig(), **options)


@pytest.mark.parametrize("records", [clouds(1, OTHER, 130, seed=1), list(scans(OTHER, 130))], ids=["3D", "2D"])
def test_a_robot_is_found_and_followed_in_six_degrees_of_freedom(finished, records, tmp_path):
    run = localized(records, finished)
    distance_m, turn_rad = errors(run, OTHER)
    assert (run.metrics["fixes"].value, run.metrics["losses"].value) == (1, 0)
    assert len(distance_m) > 50
    assert distance_m.max() < 0.04
    assert turn_rad.max() < 0.01
    assert run.map_files["map.ply"] == finished.ply
    run.save(tmp_path / "run")
    lines = np.loadtxt(tmp_path / "run" / "trajectories" / "carol.tum")
    assert lines[:, 1:] == pytest.approx(run.trajectories["carol"].T_map_base_6d, abs=1e-8)
    again = open_run(tmp_path / "run").localized["carol"]
    assert again.is_localized.sum() == len(lines) < len(records) == len(again.stamps)


def test_a_session_that_begins_anew_is_found_anew(finished):
    first, turns = clouds(1, OTHER, 130, seed=1), clouds(1, OTHER, 130, seed=2)
    wheels = np.array([100.0, 0.0, 0.0, 0.0])
    later = [replace(scan, stamp=scan.stamp - 100.0, wheels=scan.wheels - wheels) for scan in turns]
    run = localized([*first, *later], finished)
    assert (run.metrics["fixes"].value, run.metrics["losses"].value) == (2, 1)
    poses = run.localized["carol"]
    assert len(poses.stamps) == 260
    assert not poses.is_localized[130:150].any(), "nobody knows where the second session is yet"
    assert np.hypot(*(poses.T_map_base[259] - poses.T_map_base[129])[:2]) < 0.05


def test_a_robot_in_another_building_stays_without_a_pose(finished):
    assert localized(clouds(5, OTHER, 130, seed=1), finished).metrics["fixes"].value == 0


def test_a_bag_of_clouds_is_localized_by_its_whole_clouds(folder, tmp_path, capsys):
    bag = save(tmp_path / "drive.mcap", drive_elsewhere())
    assert main(["localize", f"carol={bag}", "--map", str(folder), "-o", str(tmp_path / "run")]) == 0
    assert "carol: not localized in 14 scans; is this the right map" in capsys.readouterr().out
    assert (tmp_path / "run" / "map.ply").read_bytes() == (folder / "map.ply").read_bytes()
    assert main(["localize", str(bag), "--map", str(folder), "-o", str(tmp_path / "other"), "--update"]) == 2
    assert "has clouds of a 3D LiDAR; only scans of a 2D laser update a map" in capsys.readouterr().err


def test_a_robot_stands_on_the_floor_with_its_inclination():
    x, y = np.meshgrid(np.arange(-6.0, 6.0, 0.1), np.arange(-3.0, 3.0, 0.1))
    slope, table = np.radians(6.0), (np.hypot(x, y - 2.0) < 0.4).ravel()
    points = np.column_stack((x.ravel(), y.ravel(), np.tan(slope) * x.ravel()))
    points += np.random.default_rng(0).normal(0.0, 2e-3, points.shape)
    normals = np.broadcast_to((-np.sin(slope), 0.0, np.cos(slope)), points.shape)
    above = points[table] + (0.0, 0.0, 0.7)
    space = SpaceMap(np.concatenate((points, above)), np.concatenate((normals, normals[table])))
    for pose in ((1.0, 0.5, 0.0), (2.0, -1.0, 2.0), (0.1, 2.0, -1.0)):
        standing = space.on_floor(np.array(pose))
        assert standing[:3] == pytest.approx((*pose[:2], np.tan(slope) * pose[0]), abs=0.01)
        assert se3.rotation(standing)[:, 2] == pytest.approx(normals[0], abs=0.01)
        assert se3.to_plane(standing)[2] == pytest.approx(pose[2], abs=0.01)
        assert se3.to_plane(space.on_floor(np.array(pose), is_level=True)) == pytest.approx(pose, abs=1e-6)
    assert np.isnan(space.on_floor(np.full(3, np.nan))).all()


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda ply: ply[:-1], "is not a file of points"),
        (lambda ply: ply + b"x", "is not a file of points"),
        (lambda ply: ply.replace(b"0.1", b"0.2"), "is not a file of points"),
        (lambda _: b"", "is not a file of points"),
        (lambda ply: ply[:-27] + np.float32(np.nan).tobytes() + ply[-23:], "has points that no map has"),
        (lambda ply: ply[:-27] + np.float32(1e9).tobytes() + ply[-23:], "has points that no map has"),
    ],
)
def test_a_file_of_points_is_read_as_it_was_written_or_refused(damage, reason):
    points = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 135]], np.int16)
    scanner, seen_from = np.array([[0, 0, 50]], np.int16), np.zeros(3, np.uint8)
    ply = ply_of([(VoxelMap(KeyscanId("a", 0), 0, 0, se3.IDENTITY, points, scanner, seen_from), se3.IDENTITY)])
    read, normals = read_points(ply, "map.ply")
    assert read == pytest.approx(0.02 * points[np.lexsort(points.T[::-1])], abs=1e-3)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=0.02)
    with pytest.raises(SourceError, match=rf"map\.ply: {reason}"):
        read_points(damage(ply), "map.ply")
