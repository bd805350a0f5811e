"""Bags that are damaged, incomplete or strange: one clear line, or a counted fault."""

import gzip
import math
import sqlite3
import struct
import warnings
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fcslam.errors import SourceError
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import BagOptions, Fault, open_fleet, open_source
from fcslam.sources.bags.codec import full_name
from tests.sources.bag_messages import (
    END,
    LASER_POSE,
    Said,
    counted,
    drive,
    mcap_file,
    mounted,
    odom,
    payload_of,
    quaternion,
    readings_in_tf,
    save,
    scan,
    text,
    tf,
    without,
)
from tests.sources.carmen_text import refusal, scans_of

pytestmark = pytest.mark.slow

FILES = ["run.bag", "run.mcap", "run.db3"]
KINDS = [*FILES, "run"]


REFUSED = {
    "empty": ([], "there are no topics"),
    "no scans": (without(drive(20), "/scan"), "no laser scans (sensor_msgs/LaserScan)"),
    "many topics": ([text(100.0, f"/chatter_{k:03}") for k in range(80)], "..."),
    "endless name": ([*drive(), scan(100.0, topic="/scan" + "[" * 2000)], "a topic's name has 2005 characters"),
    "no transform": (
        drive(20)[1:],
        "no transform from 'base_link' to 'laser', so the pose of the laser of /scan is unknown; "
        "give it with --sensors laser-pose",
    ),
    "a laser that moves": (
        drive(20)[1:] + [tf(100 + k, "base_link", "laser", (0.1 * k, 0.0, 0.0)) for k in range(4)],
        "'laser' moves in 'base_link'",
    ),
    "a laser that nods": (
        [*drive(20)[1:], *(tf(100 + k, "base_link", "laser", rotation=quaternion(pitch=0.2 * k)) for k in range(4))],
        "'laser' moves in 'base_link'",
    ),
    "a mounting in centimetres": (
        [tf(100.0, "base_link", "laser", (12.0, 0.0, 0.3), topic="/tf_static"), *drive()[1:]],
        "puts the laser of /scan 12 m from 'base_link'",
    ),
}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(("said", "words"), REFUSED.values(), ids=REFUSED)
def test_a_bag_that_cannot_be_mapped_is_refused_with_the_reason(tmp_path, name, said, words):
    assert words in refusal(save(tmp_path / name, said))


@pytest.mark.parametrize("name", KINDS)
def test_no_odometry(tmp_path, name):
    source = open_source(save(tmp_path / name, without(drive(20), "/odom")))
    (note,) = source.survey().notes
    assert "no odometry, so scan matching alone gives the motion" in note
    assert "record them at 5 Hz" not in note
    seldom = [each for k, each in enumerate(without(drive(100), "/odom")) if each.topic != "/scan" or k % 10 == 0]
    (note,) = open_source(save(tmp_path / f"seldom_{name}", seldom)).survey().notes
    assert "scans every 2 s show too little of it: record them at 5 Hz or more" in note
    scans = list(source.records())
    assert len(scans) == 20
    assert all(np.isnan(scan.T_odom_base).all() for scan in scans)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (BagOptions(("/lidar",)), ["topic /lidar is not there", "--sensors scan-topic", "/scan (sensor_msgs/Laser"]),
        (BagOptions(odom_topic="/lidar"), ["topic /lidar is not there", "odom-topic", "/odom (nav_msgs/Odometry"]),
        (BagOptions(("/odom",)), ["/odom has the type nav_msgs/Odometry", "needs sensor_msgs/LaserScan"]),
        (
            BagOptions(odom_topic="/chatter"),
            ["/chatter has the type std_msgs/String", "needs nav_msgs/Odometry, or tf"],
        ),
    ],
)
def test_a_topic_that_cannot_be_read(tmp_path, options, words):
    message = refusal(save(tmp_path / "run.mcap", [*drive(20), text(100.0)]), options)
    assert all(word in message for word in words)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_laser_with_a_second_parent_is_where_the_base_says(tmp_path, is_first):
    stray = tf(99.0 if is_first else 101.0, "camera", "laser", (9.0, 0.0, 0.0), topic="/tf_static")
    source = open_source(save(tmp_path / "run.bag", [stray, *drive(20)]))
    assert source.survey().scan_count == 20
    assert source.survey().lasers[0].T_base_laser == pytest.approx(LASER_POSE)


@pytest.mark.parametrize(("height_m", "lean_rad"), [(0.1, 0.0), (0.0, 0.1)])
def test_a_base_that_sways_with_its_body_has_its_laser_where_it_is_seen_from_above(tmp_path, height_m, lean_rad):
    said = with_fields(drive(20)[1:], "/odom", child="base_footprint")
    for k in range(80):
        sway = math.sin(0.7 * k)
        turned = quaternion(0.0, lean_rad * sway, lean_rad * math.cos(k))
        said.append(tf(100 + 0.05 * k, "base_footprint", "base_link", (0.0, 0.0, 0.1 + height_m * sway), turned))
    source = open_source(save(tmp_path / "run.mcap", [mounted(), *said]))
    assert source.survey().lasers[0].T_base_laser == pytest.approx(LASER_POSE, abs=1e-6)


@pytest.mark.parametrize(("tilt_deg", "noted"), [(1.0, False), (5.0, True), (30.0, None)])
def test_a_slight_tilt_is_read_as_level_and_a_larger_one_is_refused(tmp_path, tilt_deg, noted):
    tilted = tf(99, "base_link", "laser", rotation=quaternion(pitch=math.radians(tilt_deg)), topic="/tf_static")
    bag = save(tmp_path / "run.bag", [tilted, *drive(20)[1:]])
    if noted is None:
        assert "tilted by 30 degrees" in refusal(bag)
        assert open_source(bag, BagOptions(laser_poses=((0.0, 0.0, 0.0),))).survey().scan_count == 20
    else:
        notes = open_source(bag).survey().notes
        assert [f"tilted by {tilt_deg:.1f} degrees" in note for note in notes] == [True] * noted


def later(said, topic, by_s, recorded_s=0.0):
    """The messages of a topic by another clock, and recorded as if it were right."""
    for each in said:
        stamp = each.fields["stamp"] + (by_s if each.topic == topic else 0.0)
        bag_time = each.bag_time + (recorded_s if each.topic == topic else 0.0)
        yield each._replace(fields={**each.fields, "stamp": stamp}, bag_time=bag_time)


@pytest.mark.parametrize("by_s", [5e8, 3.0, -50.0])
def test_clocks_that_differ_are_those_of_the_recording(tmp_path, by_s):
    usual = scans_of(open_source(save(tmp_path / "usual.bag", drive(20))))
    source = open_source(save(tmp_path / "run.bag", later(drive(20), "/scan", by_s)))
    for expected, found in zip(usual, scans_of(source), strict=True):
        assert found.stamp == pytest.approx(expected.stamp + by_s, abs=1e-6)
        np.testing.assert_allclose(found.T_odom_base, expected.T_odom_base, atol=0.03)
    assert any("by the times of recording; corrected" in note for note in source.survey().notes)


@pytest.mark.parametrize("steps", [1, 2])
def test_a_clock_that_steps_back_is_kept_from_there(tmp_path, steps):
    again = [each._replace(bag_time=each.bag_time + 100 * k) for k in range(1, steps + 1) for each in drive(60)]
    source = open_source(save(tmp_path / "run.bag", drive(60) + again))
    scans = scans_of(source)
    assert source.survey().scan_count == len(scans) == 60 + 51 * steps
    assert source.faults[Fault.CLOCK_STEP].first_line == 61
    assert source.faults[Fault.MISPLACED_SCAN].count == 9 * steps
    frontend = RobotFrontend("robot", RobotConfig())
    for record in scans:
        frontend.process(record)
    frontend.finish()
    assert [len(track.stamps) for track in frontend.tracks] == [60, *[51] * steps]


@pytest.mark.parametrize(
    ("lost", "scans", "faults"),
    [
        ((104.0, 107.0), 60, {Fault.ODOMETRY_GAP: 15}),
        ((0.0, 104.05), 60 - 16, {Fault.NO_ODOMETRY: 16, Fault.HELD_ODOMETRY: 5}),
    ],
    ids=["a gap", "none at the beginning"],
)
def test_scans_without_odometry_around_them_are_counted(tmp_path, lost, scans, faults):
    said = [message for message in drive(60) if message.topic != "/odom" or not lost[0] < message.bag_time < lost[1]]
    source = open_source(save(tmp_path / "run.bag", said))
    assert len(scans_of(source)) == scans == source.survey().scan_count
    assert {kind: source.faults[kind].count for kind in faults} == faults
    assert source.survey().faults.counts == source.faults.counts


def payload(topic, kind, bag_time, content):
    return Said(topic, kind, bag_time, {"payload": content})


def hostile(time):
    """Messages that are none, lie about their sizes, or hold numbers that are none."""
    nan, inf = math.nan, math.inf
    scan_kind, odom_kind = scan(0.0).kind, odom(0.0, (0, 0, 0)).kind
    sizes = struct.pack("<IIII", 0, 1, 1, 0xFFFFFFFF)
    yield from (payload("/scan", scan_kind, time, content) for content in (b"", b"\x00" * 7, b"\xff" * 90, sizes * 9))
    yield from (payload("/odom", odom_kind, time, content) for content in (b"", b"\xff" * 400, sizes * 30))
    yield odom(time, (nan, 0.0, 0.0))
    yield odom(time, (0.0, inf, 0.0))
    yield odom(time, (1e300, 0.0, 0.0))
    yield odom(time, (0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 0.0))
    yield odom(time, (0.0, 0.0, 0.0), rotation=(nan, 0.0, 0.0, 1.0))
    yield scan(time, ())
    yield scan(time, (1.0,))
    yield scan(time, angle_min=nan)
    yield scan(time, angle_min=1e6)
    yield scan(time, angle_increment=0.0)
    yield scan(time, angle_increment=inf)
    yield scan(time, angle_increment=3.0)
    yield scan(time, angle_increment=-math.pi / 8, angle_max=1.2)
    yield scan(time, angle_max=3.0)
    yield scan(time, range_max=nan)
    yield scan(time, range_max=-1.0)
    yield scan(time, range_min=inf)


@pytest.mark.parametrize("name", ["run.bag", "run.db3"])
def test_broken_messages_are_skipped_and_counted(tmp_path, name):
    broken = [list(hostile(100.03 + 0.2 * k))[k] for k in range(24)]
    source = open_source(save(tmp_path / name, [*drive(60), *broken]))
    assert len(scans_of(source)) == 62  # two with a range_max that is none
    assert str(source.faults) == "broken messages skipped: 22 (first: message 1)"


def test_mostly_broken_messages_are_refused(tmp_path):
    broken = [payload("/odom", odom(0.0, (0, 0, 0)).kind, 100.0, b"")] * 200
    assert "most messages are damaged" in refusal(save(tmp_path / "run.bag", [*drive(20), *broken]))
    nothing = [mounted(), *(payload("/scan", scan(0.0).kind, 100 + k, b"") for k in range(30)), odom(100, (0, 0, 0))]
    assert "none of the 30 scans in /scan can be read" in refusal(save(tmp_path / "no.bag", nothing))


def with_fields(said, topic, **fields):
    return [one._replace(fields={**one.fields, **fields}) if one.topic == topic else one for one in said]


@pytest.mark.parametrize("range_max", [0.0, -1.0, math.nan, math.inf])
def test_a_range_max_that_is_none_is_unknown(tmp_path, range_max):
    source = open_source(save(tmp_path / "run.bag", with_fields(drive(30), "/scan", range_max=range_max)))
    stated = scans_of(open_source(save(tmp_path / "stated.bag", drive(30))))
    assert all((a.ranges_m == b.ranges_m).all() for a, b in zip(scans_of(source), stated, strict=True))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"range_min": 5.0, "range_max": 2.0}, "range_min 5 is not below range_max 2"),
        ({"range_min": math.inf}, "range_min inf is not below range_max 20"),
        ({"angle_increment": 0.0, "angle_max": 1.0}, "angle_increment is 0"),
        ({"angle_increment": -math.pi / 8, "angle_max": 1.2}, "angle_increment leads away from angle_max"),
        ({"angle_min": math.nan}, "an angle is not finite"),
        ({"angle_max": math.nan}, "an angle is not finite"),
        ({"angle_max": 3.0}, "8 ranges, but the angles are those of 13"),
        (
            {"angle_min": -180.0, "angle_increment": 45.0},
            "8 ranges from angle_min -180 by 45 rad have no field of view, as if in degrees: publish radians)",
        ),
        ({"ranges": ()}, "0 ranges"),
        ({"payload": b"0"}, "the bytes are not a message of this type"),
        ({"frame": "x" * 300}, "the name of a frame is too long"),
    ],
)
def test_the_field_that_is_wrong_is_named(tmp_path, fields, words):
    message = refusal(save(tmp_path / "run.bag", with_fields(drive(30), "/scan", **fields)))
    assert f"none of the 30 scans in /scan can be read ({words}" in message


NOT_A_ROTATION = (0.0, 0.0, 0.0, 0.0)


def test_odometry_without_an_orientation_is_read_from_tf(tmp_path):
    good = drive(30)
    broken = [*with_fields(good, "/odom", rotation=NOT_A_ROTATION), *readings_in_tf(good)]
    source = open_source(save(tmp_path / "run.bag", broken))
    wanted = scans_of(open_source(save(tmp_path / "good.bag", good)))
    assert all((a.T_odom_base == b.T_odom_base).all() for a, b in zip(scans_of(source), wanted, strict=True))
    why = "/odom cannot be read (the orientation 0, 0, 0, 0 is not a unit quaternion), so it is not used"
    assert why in " ".join(source.survey().notes)
    fleet = open_fleet([(tmp_path / "run.bag", "a"), (save(tmp_path / "other.bag", [*broken, text(101.0)]), "b")])
    assert all(len(scans_of(each)) == 30 for each in fleet)


def test_an_orientation_that_is_none_is_named(tmp_path):
    source = open_source(save(tmp_path / "run.bag", with_fields(drive(30), "/odom", rotation=NOT_A_ROTATION)))
    first, second = source.survey().notes
    assert "/odom cannot be read (the orientation 0, 0, 0, 0 is not a unit quaternion)" in first
    assert "no odometry" in second
    message = refusal(save(tmp_path / "tf.bag", with_fields(drive(30), "/tf_static", rotation=NOT_A_ROTATION)))
    assert "no transform from 'base_link' to 'laser', so the pose of the laser of /scan is unknown" in message
    assert "(/tf_static, message 1 of it: the orientation 0" in message


@pytest.mark.parametrize("kept", [0.01, 0.3, 0.9, 0.999])
def test_a_truncated_database_is_refused_wherever_it_ends(tmp_path, kept):
    bag = save(tmp_path / "run.db3", drive(400))
    content = bag.read_bytes()
    bag.write_bytes(content[: int(kept * len(content))])
    message = refusal(bag)
    assert "the bag cannot be read" in message
    assert "ros2 bag reindex" in message


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("run.bag.gz", gzip.compress, "unpack it first"),
        ("metadata.yaml", lambda _: b"rosbag2_bagfile_information: {}\n", "describes a bag; give its folder"),
    ],
)
def test_a_file_that_is_not_the_bag_itself(tmp_path, name, change, words):
    other = tmp_path / name
    other.write_bytes(change(save(tmp_path / "run.bag", drive(20)).read_bytes()))
    assert words in refusal(other)


def test_a_bag_that_is_compressed_as_a_whole_by_zstd(tmp_path):
    folder = save(tmp_path / "run", drive(20), "file")
    (packed,) = folder.glob("*.zstd")
    for path in (folder, packed):
        assert len(scans_of(open_source(path))) == 20
    packed.write_bytes(packed.read_bytes()[:-100])
    assert "truncated or damaged" in refusal(packed)


def test_messages_that_are_compressed_one_by_one_are_read_without_their_metadata(tmp_path):
    folder = save(tmp_path / "run", drive(20), "message")
    (file,) = folder.glob("run.*")
    assert len(scans_of(open_source(file))) == len(scans_of(open_source(folder))) == 20


def test_a_database_that_was_not_closed(tmp_path):
    """As when the recorder was killed: what came last is in the journal beside it."""
    database = save(tmp_path / "run.db3", drive(20))
    writer = sqlite3.connect(database)
    writer.execute("pragma journal_mode=wal")
    writer.execute("insert into messages (topic_id, timestamp, data) values (1, 1, x'00')")
    writer.commit()
    with pytest.raises(SourceError, match=r"was not closed, run\.db3-wal holds its end; close it with"):
        open_source(database).survey()
    writer.close()


def test_an_old_database_without_definitions(tmp_path):
    """As the first ROS 2 recorded: neither a schema table nor message definitions."""
    database = sqlite3.connect(save(tmp_path / "run.db3", drive(20)))
    for command in (
        "drop table schema",
        "drop table message_definitions",
        "drop table metadata",
        "alter table topics drop column type_description_hash",
        "alter table topics drop column offered_qos_profiles",
        "drop index timestamp_idx",
    ):
        database.execute(command)
    database.commit()
    database.close()
    assert open_source(tmp_path / "run.db3").survey().scan_count == 20


fuzz = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.mark.parametrize("name", FILES)
@fuzz
@given(data=st.data())
def test_a_flipped_bag_never_breaks_the_reader(tmp_path, name, data):
    """Reads or refuses, with no warning and nothing left open; anything else is an error of the reader."""
    good = tmp_path / f"good_{name}"
    content = bytearray((good if good.exists() else save(good, drive(12))).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(16, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    bag = tmp_path / name
    bag.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with suppress(SourceError):
            source = open_source(bag)
            assert len(scans_of(source)) <= source.survey().scan_count


def mcap_by_another_program(path, said, profile, encoding):
    topics = {message.topic: message.kind for message in said}
    records = [(0x01, counted("<I", profile) + counted("<I", b"test"))]
    for number, (topic, kind) in enumerate(topics.items(), 1):
        name = kind if encoding == b"ros1" else full_name(kind)
        records.append((0x03, struct.pack("<H", number) + counted("<I", name.encode()) + bytes(8)))
        channel = counted("<I", topic.encode()) + counted("<I", encoding) + bytes(4)
        records.append((0x04, struct.pack("<HH", number, number) + channel))
    for message in said:
        time_ns = round(message.bag_time * 1e9)
        head = struct.pack("<HIQQ", list(topics).index(message.topic) + 1, 0, time_ns, time_ns)
        records.append((0x05, head + payload_of(message, is_ros1=encoding == b"ros1")))
    return mcap_file(path, [*records, *END])


@pytest.mark.parametrize(("profile", "encoding"), [(b"", b"cdr"), (b"ros1", b"ros1"), (b"other", b"cdr")])
def test_an_mcap_file_is_read_by_the_encoding_of_its_channels(tmp_path, profile, encoding):
    said = sorted(drive(20), key=lambda message: message.bag_time)
    scans = scans_of(open_source(mcap_by_another_program(tmp_path / "run.mcap", said, profile, encoding)))
    expected = scans_of(open_source(save(tmp_path / "usual.mcap", said)))
    assert [scan.T_odom_base.tolist() for scan in scans] == [scan.T_odom_base.tolist() for scan in expected]


def test_an_mcap_file_of_messages_that_are_not_read_is_refused_with_what_to_record(tmp_path):
    path = mcap_by_another_program(tmp_path / "run.mcap", drive(2), b"", b"json")
    assert "/odom is not in CDR; record it by `ros2 bag record`; the topics are /odom (nav_msgs/O" in refusal(path)


def test_topics_written_one_after_the_other_are_read_in_the_order_of_their_times(tmp_path):
    said = sorted(drive(20), key=lambda message: message.topic)
    expected = scans_of(open_source(save(tmp_path / "usual.bag", said)))
    with_later = [message._replace(bag_time=100.0 + 0.001 * k) for k, message in enumerate(said)]
    bag = save(tmp_path / "run.db3", with_later)
    with sqlite3.connect(bag) as database:  # the order of the rows is that of the topics
        for k, message in enumerate(said):
            database.execute("UPDATE messages SET timestamp = ? WHERE id = ?", (round(message.bag_time * 1e9), k + 1))
    database.close()
    scans = scans_of(open_source(bag))
    assert [scan.T_odom_base.tolist() for scan in scans] == [scan.T_odom_base.tolist() for scan in expected]
