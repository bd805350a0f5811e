"""Point clouds and depth images become the scan that a 2D LiDAR in the band of heights would measure."""

import math

import numpy as np
import pytest

from fcslam.lidar.scan import point_scan
from fcslam.records import LaserModel
from fcslam.sources.bags.camera import calibration_of
from fcslam.sources.bags.clouds import cloud_of, given_cloud_mounting
from fcslam.sources.bags.codec import IMAGE, LIVOX_CLOUDS, POINT_CLOUD, MessageCodec
from fcslam.sources.point_clouds import (
    DIRECTIONS,
    CloudBand,
    CloudMounting,
    directions_in,
    floor_in,
    scan_of_cloud,
)
from tests.sources.clouds import (
    DOUBLES,
    HESAI,
    LIVOX,
    OPTICAL,
    OTHER_CLOCK,
    OUSTER,
    PERIOD_S,
    REALSENSE,
    STAMP,
    VELODYNE,
    VELODYNE_FROM_END,
    Measured,
    at_rest,
    cloud,
    depth_image,
    plan_ranges,
    rotation,
    scattered,
    spinning,
)

pytestmark = pytest.mark.slow

BAND = CloudBand()


def mounting(R=None, position=(0.0, 0.0, 0.4)):
    R = np.eye(3) if R is None else R
    return CloudMounting(R, np.array(position), math.atan2(R[1, 0], R[0, 0]))


def read(message, where=None, band=BAND, kind=POINT_CLOUD, **options):
    return scan_of_cloud(cloud_of(message, kind, 0, **options), where or mounting(), band)


def errors_m(scan, heading=0.0, x=0.0, y=0.0):
    """Errors of the ranges where something was measured, and the share of such directions."""
    angles = scan.beams.angle_min_rad + scan.beams.angle_increment_rad * np.arange(scan.beams.beam_count) + heading
    seen = np.isfinite(scan.raw_ranges_m)
    return np.abs(scan.raw_ranges_m - plan_ranges(x, y, angles))[seen], seen.mean()


def assert_room(scan, share=0.97, **where):
    errors, seen = errors_m(scan, **where)
    assert np.quantile(errors, 0.97) < 0.03  # beside the edges of the crate, a direction has one or the other
    assert np.median(errors) < 0.003
    assert seen > share


def assert_turn(scan, begin_s=0.0, clockwise=False):
    """The beams were measured one after the other, the first at ``begin_s``."""
    first, last = begin_s, begin_s + PERIOD_S * (1.0 - 1.0 / DIRECTIONS)
    times = (last, first) if clockwise else (first, last)
    assert (scan.sweep.first_s, scan.sweep.last_s) == pytest.approx(times, abs=3e-4)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize(
    ("layout", "begin_s", "height"),
    [(VELODYNE, 0.0, 1), (VELODYNE_FROM_END, -PERIOD_S, 1), (OUSTER, 0.0, 16), (HESAI, 0.0, 1), (OTHER_CLOCK, 0.0, 1)],
)
def test_the_layout_of_a_spinning_scanner(layout, begin_s, height, clockwise):
    scan = read(cloud(STAMP, spinning(at_rest, clockwise=clockwise, first_rad=0.7), layout, height=height))
    assert scan.stamp == pytest.approx(STAMP)
    assert_room(scan)
    assert_turn(scan, begin_s, clockwise)


@pytest.mark.parametrize(("columns", "directions"), [(90, 240), (120, 360), (180, 360), (240, 720), (1800, 720)])
@pytest.mark.parametrize("clockwise", [False, True])
def test_the_returns_of_a_sparse_scanner_are_neighbours(columns, directions, clockwise):
    message = cloud(STAMP, spinning(at_rest, columns=columns, clockwise=clockwise, first_rad=0.7), VELODYNE)
    found = cloud_of(message, POINT_CLOUD, 0)
    assert directions_in([found], mounting()) == directions
    scan = scan_of_cloud(found, mounting()._replace(directions=directions), BAND)
    assert scan.beams.beam_count == directions
    errors, seen = errors_m(scan)
    assert seen > 0.95
    assert np.median(errors) < 0.02
    laser = LaserModel(*scan.beams, 100.0, (0.0, 0.0, 0.0))
    assert point_scan(scan.raw_ranges_m, laser).normals.any(axis=1).mean() > 0.8


@pytest.mark.parametrize(
    ("wrong_s", "share"), [(60.0, 0.1), (4.2, 0.1), (0.5, 0.1), (-1.0, 0.1), (math.nan, 0.1), (60.0, 0.4), (4.2, 0.3)]
)
def test_points_with_wrong_times_are_left_out(wrong_s, share):
    measured = spinning(at_rest, first_rad=0.7)
    lost = np.random.default_rng(1).random(len(measured.times)) < share
    message = cloud(STAMP, Measured(measured.points, np.where(lost, wrong_s, measured.times)), VELODYNE)
    assert cloud_of(message, POINT_CLOUD, 0).left_out == np.count_nonzero(lost)
    scan = read(message)
    assert_room(scan)
    assert_turn(scan)


def test_times_that_are_shares_of_a_turn_are_the_order_of_the_points():
    measured = spinning(at_rest, first_rad=0.7)
    order = np.random.default_rng(1).permutation(len(measured.times))
    mixed = Measured(measured.points[order], measured.times[order] / PERIOD_S)
    found = cloud_of(cloud(STAMP, mixed, VELODYNE), POINT_CLOUD, 0, longest_s=1.2 * PERIOD_S)
    assert found.is_in_order
    assert not len(found.times_s)
    scan = scan_of_cloud(found, mounting(), BAND)
    assert_room(scan)
    assert abs(math.remainder(scan.beams.angle_min_rad - 0.7, math.tau)) < 2.0 * math.tau / DIRECTIONS


def test_points_in_no_order_are_seen_at_their_mean_time():
    scan = read(cloud(STAMP, scattered(at_rest), LIVOX))
    assert scan.stamp == pytest.approx(STAMP + PERIOD_S / 2, abs=1e-3)
    assert_room(scan, share=0.9)


@pytest.mark.parametrize("layout", [REALSENSE, DOUBLES])
def test_a_cloud_without_times_is_measured_at_its_stamp(layout):
    scan = read(cloud(STAMP, spinning(at_rest), layout))
    assert (scan.stamp, scan.sweep) == (pytest.approx(STAMP), None)
    assert_room(scan)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("same_time", [False, True])
def test_without_times_the_order_of_the_points_shows_where_a_turn_begins(clockwise, same_time):
    measured = spinning(at_rest, clockwise=clockwise, first_rad=0.7)
    timed = read(cloud(STAMP, measured, VELODYNE))
    layout = VELODYNE if same_time else REALSENSE
    scan = read(cloud(STAMP, measured._replace(times=np.full_like(measured.times, 0.02)), layout))
    assert (scan.beams, scan.sweep) == (timed.beams, None)
    assert_room(scan)


@pytest.mark.parametrize("kind", LIVOX_CLOUDS)
@pytest.mark.parametrize("ros1", [False, True])
def test_livox_custom_messages(kind, ros1):
    codec, measured = MessageCodec(ros1), scattered(at_rest, 3000)
    points = [
        codec.make(
            kind.replace("Msg", "Point"),
            **dict(zip("xyz", map(float, point), strict=True)),
            offset_time=round(t * 1e9),
            reflectivity=1,
            tag=0,
            line=0,
        )
        for point, t in zip(measured.points.astype(np.float32), measured.times, strict=True)
    ]
    header = codec.header(round(STAMP * 1e9), "lidar")
    message = codec.make(
        kind, header=header, timebase=0, point_num=len(points), lidar_id=0, rsvd=np.zeros(3, np.uint8), points=points
    )
    scan = read(codec.decode(codec.encode(message, kind), kind), kind=kind)
    assert scan.stamp == pytest.approx(STAMP + PERIOD_S / 2, abs=1e-3)
    assert np.median(errors_m(scan)[0]) < 0.003


@pytest.mark.parametrize("clockwise", [False, True])
def test_each_direction_is_placed_where_the_robot_was_at_its_time(clockwise):
    velocity = np.array([0.5, 0.2, 1.5])
    scan = read(cloud(STAMP, spinning(lambda t: t[:, None] * velocity, clockwise=clockwise), VELODYNE))
    laser = LaserModel(*scan.beams, scan.range_max_m)
    placed, at_once = (
        point_scan(scan.raw_ranges_m, laser, sweep) for sweep in (scan.sweep._replace(velocity=tuple(velocity)), None)
    )
    distances = [
        np.abs(np.hypot(*each.points.T) - plan_ranges(0.0, 0.0, np.arctan2(*each.points.T[::-1])))
        for each in (placed, at_once)
    ]
    assert np.median(distances[0]) < 0.01
    assert np.median(distances[1]) > 0.05


@pytest.mark.parametrize(
    ("R", "position", "share"),
    [
        (rotation(roll=0.3), (0.0, 0.0, 0.5), 0.7),
        (rotation(pitch=0.35, yaw=1.0), (0.1, -0.2, 0.5), 0.7),
        (rotation(roll=math.pi, yaw=0.5), (0.0, 0.1, 0.5), 0.7),
        (rotation(0.0, 0.08), (0.0, 0.0, 0.4), None),
        (rotation(-0.06, -0.05), (0.0, 0.0, 0.4), None),
    ],
    ids=["rolled", "pitched", "upside down", "a robot that pitches", "a robot that tilts"],
)
def test_a_sensor_that_leans_sees_the_walls_and_not_the_floor(R, position, share):
    """A sensor whose mounting leans, and one of a robot that does not stand level, which the mounting does not say."""
    message = cloud(STAMP, spinning(at_rest, position, R, rings=64), OUSTER)
    where = mounting(R, position) if share else mounting(position=position)
    assert_room(read(message, where), share or 0.9, heading=where.heading_rad, x=position[0], y=position[1])


def test_the_floor_shows_the_height_of_a_sensor_that_tf_lacks():
    message = cloud(STAMP, spinning(at_rest, (0.1, 0.2, 0.55), rotation(yaw=0.3)), VELODYNE)
    assert_room(read(message, given_cloud_mounting((0.1, 0.2, 0.3), POINT_CLOUD, "lidar")), heading=0.3, x=0.1, y=0.2)
    above = cloud(STAMP, Measured(*(each[measured_above(message)] for each in spinning(at_rest))), VELODYNE)
    with pytest.raises(ValueError, match="no floor is seen"):
        read(above, given_cloud_mounting((0.0, 0.0, 0.0), POINT_CLOUD, "lidar"))


def measured_above(message):
    return spinning(at_rest).points[:, 2] > 0.0


def test_a_wall_is_no_floor():
    wall = np.stack(np.meshgrid(2.0, np.linspace(-2, 2, 60), np.linspace(0.0, 2.0, 30)), axis=-1).reshape(-1, 3)
    assert floor_in(wall, mounting()) is None


def test_the_robot_itself_is_left_out():
    measured = spinning(at_rest)
    mast = np.array([0.25, 0.1, 0.0]) + 0.02 * np.random.default_rng(0).normal(size=(400, 3))
    points, times = np.vstack((measured.points, mast)), np.append(measured.times, np.full(400, 0.05))
    message = cloud(STAMP, Measured(points, times), REALSENSE)
    assert_room(read(message))
    assert np.nanmin(read(message, band=BAND._replace(body_radius_m=0.1)).raw_ranges_m) < 0.35


def test_the_band_chooses_the_heights():
    message = cloud(STAMP, spinning(at_rest, rings=64), OUSTER)
    angle, table_m = math.atan2(1.75, -1.75), math.hypot(1.0, 1.0)
    for band, nearer in ((BAND, False), (CloudBand(0.1, 0.9), True)):
        scan = read(message, band=band)
        beam = round((angle - scan.beams.angle_min_rad) / scan.beams.angle_increment_rad) % DIRECTIONS
        assert (scan.raw_ranges_m[beam] < table_m + 1.0) == nearer


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("pitch", [0.0, 0.3])
def test_depth_images(encoding, pitch):
    image, info = depth_image(STAMP, encoding, pitch)
    R = rotation(pitch=pitch) @ OPTICAL
    where = CloudMounting(R, np.array([0.0, 0.0, 0.3]), math.atan2(R[1, 0], R[0, 0]))
    scan = read(image, where, kind=IMAGE, calibration=calibration_of(info))
    errors, seen = errors_m(scan, heading=where.heading_rad)
    assert np.quantile(errors, 0.95) < 0.03
    assert seen == pytest.approx(2 * math.atan(80 / 95) / math.tau, abs=0.02)


HOSTILE = {
    "an offset outside": ({"fields": ("y", "offset", 20)}, "field y at offset 20 is outside of point_step 22"),
    "a huge offset": ({"fields": ("x", "offset", 2**32 - 1)}, "field x at offset 4294967295 is outside"),
    "an unknown type": ({"fields": ("z", "datatype", 9)}, "field z has the datatype 9"),
    "coordinates as integers": ({"fields": ("x", "datatype", 5)}, "field x is missing or not a float"),
    "a missing axis": ({"fields": ("z", "name", "height")}, "field z is missing"),
    "a huge size": ({"width": 2**32 - 1, "height": 2**32 - 1}, "width 4294967295 and height 4294967295 are too large"),
    "too few bytes": ({"width": 10**6}, "633600 bytes of data do not hold 1 rows of 1000000 points"),
    "no step": ({"point_step": 0}, "point_step 0"),
    "short rows": ({"height": 2, "width": 14400, "row_step": 5}, "row_step 5"),
}


@pytest.mark.parametrize(("changes", "said"), HOSTILE.values(), ids=HOSTILE)
def test_an_invalid_cloud_is_refused_by_its_field(changes, said):
    message = cloud(STAMP, spinning(at_rest), VELODYNE)
    changes = dict(changes)
    if "fields" in changes:
        name, attribute, value = changes.pop("fields")
        setattr(next(field for field in message.fields if field.name == name), attribute, value)
    for attribute, value in changes.items():
        setattr(message, attribute, value)
    with pytest.raises(ValueError, match=said):
        read(message)


@pytest.mark.parametrize(
    ("attribute", "value", "said"),
    [
        ("encoding", "rgb8", "'rgb8' is not that of a depth image"),
        ("width", 2**31, "do not describe an image"),
        ("step", 1, "step 1"),
        ("height", 7, "do not fill"),
    ],
)
def test_an_invalid_depth_image_is_refused(attribute, value, said):
    image, info = depth_image(STAMP, "16UC1")
    setattr(image, attribute, value)
    with pytest.raises(ValueError, match=said):
        read(image, kind=IMAGE, calibration=calibration_of(info))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((50, 3), np.nan), np.full((50, 3), 1e30)])
def test_a_cloud_without_returns_has_none(points):
    scan = read(cloud(STAMP, Measured(points, np.zeros(len(points))), VELODYNE))
    assert np.isnan(scan.raw_ranges_m).all()


def test_big_endian_and_padded_rows():
    measured = spinning(at_rest)
    little = cloud(STAMP, measured, REALSENSE)
    swapped = np.frombuffer(little.data, "<f4").byteswap().view(np.uint8)
    big = cloud(STAMP, measured, REALSENSE, data=swapped, is_bigendian=True)
    rows = little.data.reshape(16, -1)
    padded = np.hstack((rows, np.zeros((16, 12), np.uint8)))
    apart = cloud(STAMP, measured, REALSENSE, height=16, row_step=padded.shape[1], data=padded.reshape(-1))
    expected = read(little).raw_ranges_m
    assert np.array_equal(read(big).raw_ranges_m, expected, equal_nan=True)
    assert np.array_equal(read(apart).raw_ranges_m, expected, equal_nan=True)
