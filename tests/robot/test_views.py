"""Camera places of a robot that drives through a drawn room, and that its images stay with it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.config import dump, load
from fcslam.features.detector import OnnxConfig, OnnxDetector
from fcslam.geometry import se2
from fcslam.records import Channel, ClosureStatus, Keyscan, LaserScan, Place, frozen
from fcslam.robot.frontend import RobotConfig
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import encode
from tests.features.networks import tiny_network
from tests.features.pictures import image_at
from tests.lidar.worlds import drifting, drive, path, recording, ring
from tests.small_fleet import driven, feed

pytestmark = pytest.mark.slow

EVERY = 3
"""Scans between two images."""


def records_of(waypoints, seed, walls=None, wears=lambda number: number):
    """A drive, along the drawn ring: scans, an image shortly after every third, and the true poses at the scans."""
    walls = ring() if walls is None else walls
    rng = np.random.default_rng(seed)
    poses = drive(waypoints)
    odometry = drifting(poses, rng)
    scans = list(recording(poses, odometry, walls, seed=seed))
    records = []
    for k, scan in enumerate(scans):
        records.append(scan)
        if k % EVERY == 0 and k + 1 < len(scans):
            step = 0.4 * se2.between(odometry[k], odometry[k + 1])
            true_step = 0.4 * se2.between(poses[k], poses[k + 1])
            moved = se2.compose(odometry[k], step)
            stamp = scan.stamp + 0.4 * (scans[k + 1].stamp - scan.stamp)
            records.append(image_at(stamp, se2.compose(poses[k], true_step), walls, moved, wears))
    return records, poses


@pytest.fixture(scope="module")
def seen():
    return records_of([(1.5, 1.5), (11.0, 1.5)], 1)


def bodies_of(records, config=RobotConfig()):  # noqa: B008 - frozen
    _, packets = driven(records, config)
    return [packet.body for packet in packets], packets


def places(bodies, channel=Channel.CAMERA):
    return [body for body in bodies if isinstance(body, Place) and body.channel is channel]


def test_camera_places_come_every_metre_with_heights(seen):
    bodies, packets = bodies_of(seen[0])
    found = places(bodies)
    assert 8 <= len(found) <= 11
    numbers = [place.id.number for place in found]
    assert numbers == sorted(set(numbers))
    for place in found:
        assert place.detector_version == OnnxDetector(OnnxConfig()).version
        assert place.first <= place.id.number <= place.last
        assert place.keypoints.shape == (len(place.descriptors), 3)
        assert np.all((place.keypoints[:, 2] > 0.0) & (place.keypoints[:, 2] < 3.0))
    assert [encode(packet) for packet in packets] == [encode(packet) for packet in bodies_of(seen[0])[1]]


def test_keypoints_lie_on_the_walls(seen):
    """In the frame of their keyscan, whose true pose the drive tells."""
    records, poses = seen
    bodies, _ = bodies_of(records)
    stamps = [record.stamp for record in records if isinstance(record, LaserScan)]
    at = {body.id.number: poses[stamps.index(body.stamp)] for body in bodies if isinstance(body, Keyscan)}
    walls = ring()
    for place in places(bodies):
        points = se2.transform(at[place.id.number], place.keypoints[:, :2].astype(float))
        along = walls[:, 2:] - walls[:, :2]
        share = np.einsum("kwi,wi->kw", points[:, None] - walls[:, :2], along) / np.sum(along**2, axis=1)
        foot = walls[:, :2] + np.clip(share, 0, 1)[..., None] * along
        distance = np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1)
        assert np.mean(distance < 0.08) > 0.9


def test_a_rear_laser_does_not_hide_what_the_front_one_sees(seen):
    """Each scan as one of half a turn ahead and one of half a turn behind, of which the newest tells nothing ahead."""
    halves = []
    for record in seen[0]:
        if not isinstance(record, LaserScan):
            halves.append(record)
            continue
        beams = record.laser.beam_count
        ahead = slice(beams // 4, beams // 4 + beams // 2)
        front = replace(record.laser, beam_count=beams // 2, angle_min_rad=-np.pi / 2)
        rear = replace(front, T_base_laser=(0.0, 0.0, np.pi))
        behind = np.roll(record.ranges_m, beams // 2)[ahead]
        halves.append(replace(record, ranges_m=record.ranges_m[ahead], laser=front))
        halves.append(replace(record, ranges_m=behind, laser=rear))
    whole, both = (places(bodies_of(records)[0]) for records in (seen[0], halves))
    assert len(both) >= len(whole) - 1 > 5
    counts = [np.mean([len(place.keypoints) for place in found]) for found in (whole, both)]
    assert counts[1] > 0.9 * counts[0]


def test_a_robot_that_stands_still_sees_nothing_new(seen):
    records = seen[0][: EVERY + 2]
    last = records[-1]
    standing = [replace(r, stamp=last.stamp + 0.1 * k) for k in range(20) for r in records[:2]]
    assert len(places(bodies_of(standing)[0])) == 1


def test_a_network_describes_places_in_its_own_version(seen, tmp_path):
    pytest.importorskip("onnxruntime")
    tiny_network(tmp_path / "n.onnx", version="tiny-7")
    (tmp_path / "robot.yaml").write_text(f"views: {{detector: onnx, weights: {tmp_path}/n.onnx}}")
    config = load(RobotConfig, tmp_path / "robot.yaml")
    (tmp_path / "dumped.yaml").write_text(dump(config))
    assert load(RobotConfig, tmp_path / "dumped.yaml") == config
    bodies, _ = bodies_of(seen[0], config)
    hello = next(body for body in bodies if isinstance(body, Hello))
    assert hello.detector_versions[Channel.CAMERA] == "tiny-7"
    assert len(places(bodies)) > 5
    assert {place.detector_version for place in places(bodies)} == {"tiny-7"}


def test_images_change_nothing_but_camera_places(seen):
    records, _ = seen
    sighted = [body for body in bodies_of(records)[0] if getattr(body, "channel", None) is not Channel.CAMERA]
    blind, _ = bodies_of([record for record in records if isinstance(record, LaserScan)])
    assert len(sighted) == len(blind)
    assert all(
        encode(Packet("r", 0, 0, 1e9, a)) == encode(Packet("r", 0, 0, 1e9, b))
        for a, b in zip(sighted, blind, strict=True)
    )


def test_without_odometry_at_the_image_the_robot_stands(seen):
    blind = [r if isinstance(r, LaserScan) else replace(r, T_odom_base=None) for r in seen[0]]
    assert len(places(bodies_of(blind)[0])) >= 7


def test_no_packet_holds_a_piece_of_an_image(seen):
    """Every packet that a robot with a camera sends, whatever its kind: not 12 bytes of a file, nor 12 grey levels."""
    records, _ = seen
    pieces = set()
    for image in (record for record in records if not isinstance(record, LaserScan)):
        pieces |= {image.encoded[k : k + 12] for k in range(640, len(image.encoded) - 12)}  # behind the JPEG's tables
        grey = cv2.imdecode(np.frombuffer(image.encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        rows = [row.tobytes() for row in grey[60:180:8]]
        pieces |= {row[k : k + 12] for row in rows for k in range(0, 308) if len(set(row[k : k + 12])) > 6}
    _, packets = bodies_of(records)
    assert {type(packet.body).__name__ for packet in packets} >= {"Hello", "Keyscan", "Constraint", "Place"}
    for packet in packets:
        data = encode(packet)
        assert not any(data[k : k + 12] in pieces for k in range(len(data) - 11))


def test_what_cameras_saw_joins_two_maps():
    """Two robots that drive the same way, from unknown starts: camera places alone tell how they lie."""
    ways = [(1.5, 1.5), (12.5, 1.5)], [(3.0, 1.6), (12.5, 1.6)]
    config, cloud, truth = RobotConfig(channels=(Channel.CAMERA,)), Cloud(FleetConfig(), 0), {}
    for number, way in enumerate(ways):
        records, poses = records_of(way, 10 + number)
        robot, packets = driven(records, config, f"r{number}")
        feed(cloud, packets)
        truth[robot.robot] = poses[0]
    result = cloud.finalize()
    assert {robot.map_index for robot in result.robots} == {0}
    accepted = [c for c in result.closures if c.status is ClosureStatus.ACCEPTED and c.i.robot != c.j.robot]
    assert len(accepted) >= 3
    assert {closure.channel for closure in accepted} == {Channel.CAMERA}
    starts = [robot.T_map_base[0] for robot in result.robots]
    true_starts = [truth[robot.robot] for robot in result.robots]
    off = se2.between(se2.between(*true_starts), se2.between(*starts))
    assert np.hypot(off[0], off[1]) < 0.1


def test_a_view_whose_surroundings_no_submap_shows_is_left_out(seen):
    """Scans are missing while the robot drives 20 m: what it saw before it has no submap after it."""
    records, _ = seen
    jumped = [
        replace(r, T_odom_base=frozen(r.T_odom_base + np.array([20.0, 0.0, 0.0]))) if k > len(records) // 3 else r
        for k, r in enumerate(records)
    ]
    bodies, packets = bodies_of(jumped)
    assert places(bodies)
    for place in places(bodies):
        assert place.first <= place.id.number <= place.last
    for packet in packets:
        encode(packet)


def test_an_image_of_another_size_than_its_camera_is_left_out(seen):
    records = [r if isinstance(r, LaserScan) else replace(r, camera=replace(r.camera, width=100)) for r in seen[0]]
    assert places(bodies_of(records)[0]) == []


def corridor_of_one_pattern(period_m):
    """Two bare walls that wear the same pattern again and again: `pictures` gives walls patterns by their number."""
    ends = np.arange(-60.0, 80.0, period_m)
    south = [path((x, -1.0), (x + period_m, -1.0)) for x in ends]
    north = [path((x + period_m, 1.0), (x, 1.0)) for x in ends]
    return np.vstack((*south, *north)), len(ends)


def test_corridors_that_repeat_themselves_join_nothing_by_their_images_alone():
    """Two robots in stretches 24 m apart that look the same: no wall fixes a match, so nobody guesses."""
    walls, count = corridor_of_one_pattern(8.0)
    config, cloud = RobotConfig(channels=(Channel.CAMERA,)), Cloud(FleetConfig(), 0)
    for number, start in enumerate((0.0, 24.0)):
        records, _ = records_of([(start, 0.0), (start + 9.0, 0.0)], 10 + number, walls, lambda number: number // count)
        _, packets = driven(records, config, f"r{number}")
        assert any(isinstance(packet.body, Place) for packet in packets)
        feed(cloud, packets)
    result = cloud.finalize()
    assert len({robot.map_index for robot in result.robots}) == 2
    assert not [c for c in result.closures if c.status is ClosureStatus.ACCEPTED and c.i.robot != c.j.robot]
    assert [c for c in result.closures if c.i.robot != c.j.robot], "the images were not even alike"
