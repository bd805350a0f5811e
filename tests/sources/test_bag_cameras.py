"""Cameras in bags: what is written reads back, what others write is read, and what is missing turns the camera off."""

from itertools import count

import cv2
import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.highlevel import AnyReader

from fcslam.errors import SourceError
from fcslam.records import CameraImage, LaserScan
from fcslam.sources import BagOptions, Fault, open_source, write_bag
from fcslam.sources.bags.codec import IMAGE, full_name
from tests.sources.bag_messages import CODECS, STORES
from tests.sources.camera_records import CAMERA, drive, image, png, same

pytestmark = pytest.mark.slow

STORE = STORES[False]
KINDS = ["run.bag", "run.mcap", "run.db3", "run"]
PIXELS = np.arange(CAMERA.height * CAMERA.width * 3, dtype=np.uint8).reshape(CAMERA.height, CAMERA.width, 3)


def images(source):
    return [record for record in source.records() if isinstance(record, CameraImage)]


@pytest.mark.parametrize("name", KINDS)
def test_images_and_their_camera_read_back_to_the_last_bit(tmp_path, name):
    encoded = cv2.imencode(".jpg", PIXELS)[1].tobytes()
    records = drive(10)
    records[2] = image(records[2].stamp, records[2].T_odom_base, encoded)
    write_bag(tmp_path / name, records)
    source = open_source(tmp_path / name)
    assert source.survey().camera == CAMERA
    assert source.survey().notes == ()
    assert all(map(same, [r for r in records if isinstance(r, CameraImage)], images(source)))
    assert len(images(source)) == 10
    assert not source.faults


def test_others_read_the_camera(tmp_path):
    write_bag(tmp_path / "run.mcap", drive(5))
    with AnyReader([tmp_path / "run.mcap"], default_typestore=STORE) as reader:
        kinds = {topic: (info.msgtype, info.msgcount) for topic, info in reader.topics.items()}
        messages = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
    assert kinds["/camera/image_raw/compressed"] == ("sensor_msgs/msg/CompressedImage", 5)
    assert kinds["/camera/camera_info"] == ("sensor_msgs/msg/CameraInfo", 5)
    said = dict(reversed(messages))
    info = said["/camera/camera_info"]
    assert info.k.tolist() == [7.25, 0, 3.5, 0, 7.5, 2.5, 0, 0, 1]
    assert info.p.tolist() == [7.25, 0, 3.5, 0, 0, 7.5, 2.5, 0, 0, 0, 1, 0]
    assert bytes(said["/camera/image_raw/compressed"].data) == png(shade=0)
    statics = {m.transforms[0].child_frame_id: m.transforms[0] for topic, m in messages if topic == "/tf_static"}
    rotation = statics[info.header.frame_id].transform.rotation
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == CAMERA.T_base_camera.rotation


def rewritten(tmp_path, change):
    """The bag of a drive with each message as ``change(topic, type, message)`` has it: the same three, or None."""
    write_bag(tmp_path / "before.mcap", drive(5))
    with (
        AnyReader([tmp_path / "before.mcap"], default_typestore=STORE) as reader,
        rosbag2.Writer(tmp_path / "after", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer,
    ):
        connections = {}
        for connection, bag_time, raw in reader.messages():
            changed = change(connection.topic, connection.msgtype, reader.deserialize(raw, connection.msgtype))
            if changed is None:
                continue
            topic, kind, message = changed
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], bag_time, STORE.serialize_cdr(message, kind))
    return tmp_path / "after"


def as_raw(encoding, pixels, padding=0):
    """A change that turns compressed images into raw ones."""

    def change(topic, kind, message):
        if topic != "/camera/image_raw/compressed":
            return topic, kind, message
        rows = pixels.reshape(CAMERA.height, -1)
        padded = np.hstack([rows, np.full((CAMERA.height, padding), 255, np.uint8)])
        size = {"height": CAMERA.height, "width": CAMERA.width, "step": padded.shape[1]}
        raw = CODECS[False].make(IMAGE, header=message.header, **size, encoding=encoding, data=padded.ravel())
        return "/camera/image_raw", full_name(IMAGE), raw

    return change


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "expected_bgr"),
    [
        ("bgr8", PIXELS, PIXELS),
        ("rgb8", PIXELS, PIXELS[..., ::-1]),
        ("mono8", PIXELS[..., 0], np.repeat(PIXELS[..., :1], 3, axis=2)),
    ],
)
def test_raw_images_lose_nothing(tmp_path, encoding, pixels, expected_bgr, padding):
    source = open_source(rewritten(tmp_path, as_raw(encoding, pixels, padding)))
    read = images(source)
    assert len(read) == 5
    decoded = cv2.imdecode(np.frombuffer(read[0].encoded, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(decoded, expected_bgr)


def without(*lost):
    return lambda topic, kind, message: None if topic in lost else (topic, kind, message)


def calibrated(field, value):
    """A change of a field of the calibration."""

    def change(topic, kind, message):
        if topic == "/camera/camera_info":
            setattr(message, field, value)
        return topic, kind, message

    return change


def unmounted(topic, kind, message):
    if topic == "/tf_static" and message.transforms[0].child_frame_id != "laser":
        return None
    return topic, kind, message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("/camera/camera_info"), "no calibration"),
        (calibrated("k", np.zeros(9)), "never calibrated"),
        (unmounted, "no transform from 'base_link' to 'camera_optical_frame'"),
    ],
)
def test_without_all_of_it_the_camera_is_left_out_and_the_laser_goes_on(tmp_path, change, words):
    source = open_source(rewritten(tmp_path, change))
    (note,) = source.survey().notes
    assert words in note
    assert "left out" in note
    assert source.survey().camera is None
    assert images(source) == []
    assert sum(isinstance(record, LaserScan) for record in source.records()) == 5
    assert not source.faults


def test_distortion_is_said(tmp_path):
    source = open_source(rewritten(tmp_path, calibrated("d", np.full(5, 0.1))))
    assert "distorted" in source.survey().notes[0]
    assert len(images(source)) == 5


def test_an_image_that_is_none_is_left_out_and_counted(tmp_path):
    number, jpeg = count(), bytearray(cv2.imencode(".jpg", np.zeros((6, 8), np.uint8))[1])
    size = jpeg.index(b"\xff\xc0") + 5
    jpeg[size : size + 4] = b"\xff\xff\xff\xff"  # 65535 x 65535 pixels

    def change(topic, kind, message):
        if topic == "/camera/image_raw/compressed":
            message.data = np.frombuffer({2: b"no image", 3: png(9, 6), 4: jpeg}.get(next(number), png()), np.uint8)
        return topic, kind, message

    source = open_source(rewritten(tmp_path, change))
    assert len(images(source)) == 2
    assert (source.faults[Fault.BROKEN_IMAGE].count, source.faults[Fault.BROKEN_IMAGE].first_line) == (3, 3)
    assert source.survey().scan_count == 5


def test_the_camera_heard_most_is_chosen_and_said_and_the_user_may_choose(tmp_path):
    numbers = {"compressed": count(), "camera_info": count()}

    def doubled(topic, kind, message):
        """Every second image and its calibration are of another camera."""
        sensor = topic.rpartition("/")[2]
        is_rear = sensor in numbers and next(numbers[sensor]) % 2
        return topic.replace("/camera/", "/rear/") if is_rear else topic, kind, message

    bag = rewritten(tmp_path, doubled)
    source = open_source(bag)
    (note,) = source.survey().notes
    assert "reads images from /camera/image_raw/compressed, not from /rear/image_raw/compressed" in note
    assert "--sensors camera-topic" in note
    assert len(images(source)) == 3
    rear = open_source(bag, BagOptions(camera_topic="/rear/image_raw/compressed"))
    assert len(images(rear)) == 2
    with pytest.raises(SourceError, match="--sensors camera-topic needs sensor_msgs/CompressedImage"):
        open_source(bag, BagOptions(camera_topic="/scan")).survey()


def test_the_truth_is_never_taken_for_odometry(tmp_path):
    """Not even where it is the only topic of its type: then odometry is read from tf."""

    def as_truth(topic, kind, message):
        if topic == "/odom":
            message.pose.pose.position.x += 7.0
        return "/ground_truth" if topic == "/odom" else topic, kind, message

    scans = [r for r in open_source(rewritten(tmp_path, as_truth)).records() if isinstance(r, LaserScan)]
    assert [record.T_odom_base[0] for record in scans] == [0.125 * k for k in range(5)]
    (tmp_path / "again").mkdir()
    alone = rewritten(tmp_path / "again", lambda *said: None if said[0] == "/tf" else as_truth(*said))
    assert all(np.isnan(each.T_odom_base).all() for each in open_source(alone).records() if isinstance(each, LaserScan))
    assert open_source(alone, BagOptions(odom_topic="/ground_truth")).survey().scan_count == 5
