"""Clouds that are read whole: from bags with wheels and an IMU, from files, and bad ones."""

import re
import time
from pathlib import Path

import numpy as np
import pytest

import fcslam
from fcslam.errors import SourceError
from fcslam.records import CloudScan, LaserScan, Odometry
from fcslam.sources import BagOptions, open_fleet
from fcslam.sources.bags.codec import IMU
from fcslam.sources.cloud_files import read_cloud
from fcslam.sources.clouds_in_space import reader_of
from fcslam.sources.point_clouds import CloudBand, CloudMounting, PointCloud
from tests.sources.bag_messages import CODECS, Said, header, odom, quaternion, save, scan, tf
from tests.sources.clouds import VELODYNE, Measured, cloud, rotation, said, spinning, xyz
from tests.sources.test_bag_clouds import START, pose_at
from tests.sources.test_bag_clouds import drive as drive_in_the_room

LIDAR = (0.1, 0.05, 0.4)
IN_3D = BagOptions(in_3d=True)


def imu(t, rate=(0.0, 0.0, 0.8)):
    vector, codec = CODECS[False].vector, CODECS[False]
    turn, force = vector("Vector3", *rate), vector("Vector3", z=9.81)
    message = codec.make(IMU, header=header(START + t, "imu"), angular_velocity=turn, linear_acceleration=force)
    return Said("/imu", IMU, START + t, {"payload": codec.encode(message, IMU)})


def drive(layout=VELODYNE, R=None, scale=1.0, rings=16, mounting=LIDAR, is_stamped=True):
    messages = [tf(START, "base_link", "lidar", mounting, topic="/tf_static")]
    messages.append(tf(START, "base_link", "imu", rotation=quaternion(roll=np.pi), topic="/tf_static"))
    for t in np.arange(0.0, 1.6, 0.02):
        messages += [odom(START + t, pose_at([t])[0]), imu(t, (0.0, 0.0, -0.8))]
    for t in np.arange(0.1, 1.5, 0.1).round(3).tolist():
        measured = spinning(lambda times, t=t: pose_at(t + times), LIDAR, R, rings=rings, columns=180)
        measured = Measured(scale * measured.points, measured.times)
        messages.append(said("/points", START + t, cloud((START + t) * is_stamped, measured, layout)))
    return messages


def timed(times):
    return 16, [*xyz(), ("time", "f4", 12, times)]


def shuffled(values):
    return np.random.default_rng(0).permutation(values)


def opened(tmp_path, messages, options=IN_3D):
    (source,) = open_fleet([(save(tmp_path / "drive.mcap", messages), "anna")], options)
    return source


@pytest.mark.parametrize("layout", [VELODYNE, (12, xyz()), timed(lambda measured: 0.1 * measured.times)])
def test_clouds_carry_the_readings_of_wheels_and_imu_up_to_their_end(tmp_path, layout):
    early = [m._replace(bag_time=m.bag_time - 0.1 * (m.topic == "/points")) for m in drive(layout)]
    source = opened(tmp_path, early)
    scans = list(source.records())
    survey = source.survey()
    assert survey.scan_count == len(scans) == 14
    assert survey.path_length_m == pytest.approx(0.5 * 0.8 * 1.6, abs=0.02)
    assert not source.faults
    for each in scans:
        assert isinstance(each, CloudScan)
        assert each.origin_m == pytest.approx(LIDAR)
        assert float(each.times_s.max()) == pytest.approx(0.1, abs=0.01)
    wheels, gyro = (np.concatenate([getattr(each, name) for each in scans]) for name in ("wheels", "imu"))
    assert (np.diff(wheels[:, 0]) > 0.0).all()
    assert wheels[:, 1:] == pytest.approx(pose_at(wheels[:, 0] - START), abs=1e-6)
    assert gyro[:, 3] == pytest.approx(0.8)  # the IMU is upside down, and tf says so
    assert all(each.wheels[-1, 0] >= each.stamp + 0.09 for each in scans)
    floor = np.abs(scans[0].points_m[:, 2]) < 0.02
    assert 0.05 < floor.mean() < 0.6


def test_without_wheels_a_notice_says_whether_a_gyro_gives_the_turns(tmp_path):
    wheelless = [each for each in drive() if each.topic != "/odom"]
    (note,) = opened(tmp_path, wheelless).survey().notes
    assert "no odometry, so scan matching and the gyro give the motion; where" in note
    (note,) = opened(tmp_path, [each for each in wheelless if each.topic != "/imu"]).survey().notes
    assert "no odometry, so scan matching alone gives the motion; where" in note


def test_a_robot_with_a_laser_stays_in_the_plane(tmp_path):
    ranges = np.linspace(2.0, 3.0, 90)
    scans = [scan(START + t, ranges + t, angle_increment=np.pi / 90) for t in np.arange(0.1, 1.5, 0.1)]
    laser = [tf(START, "base_link", "laser", topic="/tf_static")]
    messages = [each for each in drive() if each.topic != "/points"] + laser + scans
    assert {type(each) for each in opened(tmp_path, messages).records()} == {LaserScan, Odometry}


def test_without_wheels_scans_carry_the_turns_of_the_gyro(tmp_path):
    ranges = np.linspace(2.0, 3.0, 90)
    messages = [each for each in drive() if each.topic not in ("/points", "/odom")]
    messages.append(tf(START, "base_link", "laser", topic="/tf_static"))
    messages += [
        scan(START + t, ranges + t, angle_increment=np.pi / 90, time_increment=1e-3) for t in np.arange(0.1, 1.4, 0.1)
    ]
    scans = list(opened(tmp_path, messages, None).records())
    assert len(scans) == 13
    readings = np.concatenate([each.gyro for each in scans])
    assert (np.diff(readings[:, 0]) > 0.0).all()
    assert readings[:, 1] == pytest.approx(0.8)
    assert all(each.gyro[-1, 0] > each.stamp + each.sweep.last_s - 0.03 for each in scans)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"scale": 1000.0}, "as if in another unit; publish them in metres"),
        ({"rings": 1}, "has one ring, so it is a 2D laser; map it without --3d"),
    ],
)
def test_clouds_that_cannot_be_mapped_are_refused_in_one_line(tmp_path, changes, reason):
    with pytest.raises(SourceError, match=reason) as refused:
        opened(tmp_path, drive(**changes)).survey()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ({"layout": (12, xyz())}, "have no times in a usual unit; their order gives them$"),
        ({"layout": timed(lambda measured: 0.1 * measured.times)}, "contradict how the LiDAR turns; their order gives"),
        ({"layout": timed(lambda measured: shuffled(measured.times))}, "contradict how the LiDAR turns"),
        ({"R": rotation(roll=np.pi)}, "the LiDAR is upside down; corrected"),
        ({"layout": timed(lambda measured: measured.times[::-1])}, "fall from the first to the last"),
        ({"mounting": (0.0, 0.0, 3.0)}, "no floor is seen where the mounting has it"),
        ({"R": rotation(pitch=np.radians(40.0))}, "no floor is seen where the mounting has it"),
    ],
)
def test_what_is_wrong_with_clouds_is_said_in_one_line(tmp_path, changes, note):
    source = opened(tmp_path, drive(**changes))
    found = [each for each in source.survey().notes if "/points" in each]
    assert len(found) == 1
    assert re.search(note, found[0])
    first = next(iter(source.records()))
    if "no floor" not in note:
        assert (np.abs(first.points_m[:, 2]) < 0.05).mean() > 0.05
    assert float(np.ptp(first.times_s)) == pytest.approx(0.1, abs=0.02)


def test_clouds_without_stamps_have_the_times_of_their_recording(tmp_path):
    source = opened(tmp_path, drive(is_stamped=False))
    assert [each.stamp for each in source.records()] == pytest.approx(START + np.arange(0.2, 1.6, 0.1))
    assert "14 of 14 messages of /points have no stamp; their times of recording" in " ".join(source.survey().notes)


@pytest.mark.parametrize("height_m", [0.3, 0.7])
@pytest.mark.parametrize("rings", [16, 64])
@pytest.mark.parametrize("is_upside_down", [False, True])
def test_a_lidar_that_is_upside_down_is_found_at_any_height(height_m, rings, is_upside_down):
    R, at = rotation(roll=np.pi * is_upside_down), (0.0, 0.0, height_m)
    points = [
        spinning(lambda times, t=t: pose_at(t + times), at, R, rings, 180).points for t in np.arange(0.0, 1.0, 0.1)
    ]
    clouds = [PointCloud(0.1 * number, "lidar", each, np.empty(0)) for number, each in enumerate(points)]
    reader, notes = reader_of(clouds, CloudMounting(np.eye(3), np.array(at), 0.0), CloudBand(), "/points")
    said = [note for note in notes if "have no times" not in note]
    assert [note.partition(", so ")[2] for note in said] == is_upside_down * [
        "the LiDAR is upside down; corrected: correct it in tf"
    ]
    assert reader.mounting.rotation == pytest.approx(R)


def test_a_recording_that_is_given_twice_is_refused(tmp_path):
    path = save(tmp_path / "drive.mcap", drive_in_the_room(2.5))
    with pytest.raises(SourceError, match=r"ben and anna have the same scans at .* s, so they are copies"):
        fcslam.map_recordings({"anna": path, "ben": path}, config={"fleet": {"dimensions": 3}})


def pcd(points, kind):
    head = f"VERSION .7\nFIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 4\nWIDTH {len(points)}\nHEIGHT 1\n"
    head += f"POINTS {len(points)}\nDATA {kind}\n"
    if kind == "ascii":
        head = head.replace(" _", "").replace("4 4 4 1", "4 4 4").replace("F U", "F").replace("1 1 1 4", "1 1 1")
        return head.encode() + "\n".join(" ".join(map(str, row)) for row in points.tolist()).encode()
    rows = np.zeros(len(points), [("p", "<f4", 3), ("_", "u1", 4)])
    rows["p"] = points
    return head.encode() + rows.tobytes()


def ply(points, kind):
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if kind == "ascii":
        return head.encode() + "\n".join(" ".join(map(str, row)) for row in points.tolist()).encode()
    return head.encode() + points.astype(">f4" if "big" in kind else "<f4").tobytes()


@pytest.mark.parametrize("kind", ["bin", "pcd ascii", "pcd binary", "ply ascii", "ply binary_big_endian"])
def test_folders_of_clouds_are_recordings(tmp_path, kind):
    suffix, _, coding = kind.partition(" ")
    folder = tmp_path / "velodyne"
    folder.mkdir()
    made = []
    for number in range(12):
        points = spinning(lambda times, t=0.1 * number: pose_at(t + times), LIDAR, columns=90).points
        made.append(points.astype(np.float32))
        content = {
            "bin": lambda p: np.column_stack((p, np.zeros(len(p)))).astype("<f4").tobytes(),
            "pcd": lambda p: pcd(p, coding),
            "ply": lambda p: ply(p, coding),
        }[suffix](made[-1])
        (folder / f"{number:06d}.{suffix}").write_bytes(content)
    (tmp_path / "times.txt").write_text("\n".join(f"{0.1 * number:e}" for number in range(12)))
    (source,) = open_fleet([(Path(tmp_path), "anna")], IN_3D)
    scans = list(source.records())
    assert [each.stamp for each in scans] == pytest.approx(0.1 * np.arange(12))
    outside = np.hypot(made[3][:, 0], made[3][:, 1]) > 0.4
    assert scans[3].points_m - scans[3].origin_m.astype(np.float32) == pytest.approx(made[3][outside], abs=1e-5)
    assert scans[3].origin_m[2] == pytest.approx(0.4, abs=0.02)
    with pytest.raises(SourceError, match="map them with --3d"):
        open_fleet([(Path(tmp_path), "anna")])


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (
            ["1700000000.050000", "1700000000.150000", "1700000000.950000"],
            [1700000000.05, 1700000000.15, 1700000000.95],
        ),
        (["9.95", "10.05", "10.85"], [9.95, 10.05, 10.85]),
        (["1700000000", "1700000001", "1700000002"], [1700000000.0, 1700000001.0, 1700000002.0]),
        (["1700000000050", "1700000000150", "1700000000950"], [1700000000.05, 1700000000.15, 1700000000.95]),
        (["8", "9", "10"], None),
        (["0", "100", "200"], None),
        (["scan_8", "scan_9", "scan_10"], None),
        (["inf", "infinity", "nan"], None),
        (["1e300", "2e300", "3e300"], None),
    ],
)
def test_names_of_clouds_give_their_times_or_a_notice_says_what_is_assumed(tmp_path, names, stamps):
    for x, name in enumerate(names):
        points = spinning(pose_at, LIDAR, columns=90).points + np.array([0.1 * x, 0.0, 0.0])
        (tmp_path / f"{name}.ply").write_bytes(ply(points, "ascii"))
    (source,) = open_fleet([(Path(tmp_path), "anna")], IN_3D)
    scans = list(source.records())
    assert [each.stamp for each in scans] == pytest.approx([0.0, 0.1, 0.2] if stamps is None else stamps, abs=1e-4)
    assert np.diff([float(each.points_m[:, 0].max()) for each in scans]) == pytest.approx(0.1, abs=1e-3)
    said = [note for note in source.survey().notes if "count as 0.1 s apart; write one each to times.txt" in note]
    assert len(said) == (stamps is None)


def timed_pcd(measured, count):
    """A PCD file whose points have ``count`` times each, unsigned nanoseconds."""
    rows = np.zeros(len(measured.points), [("p", "<f4", 3), ("t", "<u4", count)])
    rows["p"], rows["t"] = measured.points, 1e9 * measured.times[:, None]
    head = f"FIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 {count}\nPOINTS {len(rows)}\nDATA binary\n"
    return head.encode() + rows.tobytes()


def test_a_file_has_the_times_of_its_points_or_is_refused(tmp_path):
    measured = spinning(pose_at, LIDAR, columns=90)
    (tmp_path / "cloud.pcd").write_bytes(timed_pcd(measured, 1))
    assert read_cloud(tmp_path / "cloud.pcd", 1.0).times_s == pytest.approx(measured.times, abs=1e-8)
    (tmp_path / "cloud.pcd").write_bytes(timed_pcd(measured, 2))
    with pytest.raises(SourceError, match=r"cloud\.pcd: is not a cloud that can be read"):
        read_cloud(tmp_path / "cloud.pcd", 1.0)


def test_a_broken_file_is_left_out_and_times_must_be_there(tmp_path):
    points = spinning(pose_at, LIDAR, columns=90).points
    for number in range(4):
        (tmp_path / f"{number}.ply").write_bytes(ply(points, "ascii") if number != 2 else b"ply\nnonsense")
    (source,) = open_fleet([(Path(tmp_path), "anna")], IN_3D)
    with pytest.raises(SourceError, match=r"2\.ply: is not a cloud that can be read"):
        source.survey()
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    (source,) = open_fleet([(Path(tmp_path), "anna")], IN_3D)
    with pytest.raises(SourceError, match="has 2 times for 4 clouds"):
        source.survey()
    (tmp_path / "times.txt").write_text("0.0\nnan\n0.2\n0.3\n")
    (source,) = open_fleet([(Path(tmp_path), "anna")], IN_3D)
    with pytest.raises(SourceError, match="'nan' is not a time"):
        source.survey()


def test_dates_are_those_of_utc_wherever_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    points = spinning(pose_at, LIDAR, columns=90).points
    for number in range(3):
        (tmp_path / f"{number}.ply").write_bytes(ply(points, "ascii"))
    (tmp_path / "timestamps.txt").write_text("\n".join(f"2011-09-26 13:02:25.{k}94360375" for k in range(3)))
    (source,) = open_fleet([(Path(tmp_path), "anna")], IN_3D)
    stamps = [each.stamp for each in source.records()]
    monkeypatch.undo()
    time.tzset()
    assert stamps == pytest.approx([1317042145.09436, 1317042145.19436, 1317042145.29436])
