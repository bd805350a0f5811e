"""What a laser sees of its own robot: it is found, proposed and left out of the map."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from fcslam.config import parse
from fcslam.errors import InputError
from fcslam.lidar.frontend import LidarConfig
from fcslam.lidar.own_body import body_radius_m, body_sectors, is_in_sectors
from fcslam.records import LaserModel, frozen
from fcslam.robot.calibrating import bodies_of
from fcslam.robot.mapped_scans import MappedScans
from fcslam.sources import open_source, write_bag
from tests.lidar import worlds

LASER = LaserModel(360, -math.pi, math.radians(1.0), 12.0, (0.2, 0.0, math.pi / 2))
POSES = worlds.drive([(-3.0, -1.0), (1.5, -2.0), (3.2, 1.0), (-0.5, 2.0)], step_m=0.15)
SCANS = worlds.recording(POSES, POSES, worlds.room(), LASER)
POSTS_DEG = ((40, 46), (-3, 4), (130, 133))
"""Headings of the posts of a robot in ``base``."""


def with_posts(scans=SCANS, posts=POSTS_DEG):
    hidden = is_in_sectors(LASER, tuple((first, last - 0.5) for first, last in posts))
    return [replace(scan, ranges_m=frozen(np.where(hidden, 0.3, scan.ranges_m), np.float32)) for scan in scans]


def test_the_posts_of_a_robot_are_found_within_two_degrees():
    found = sorted(body_sectors(with_posts()))
    for sector, post in zip(found, sorted(POSTS_DEG), strict=True):
        assert post[0] - 2.0 <= sector[0] <= post[0]
        assert post[1] <= sector[1] <= post[1] + 2.0


@pytest.mark.parametrize("post", [(350, 360), (1, 360), (0, 360)])
def test_what_is_proposed_up_to_the_front_is_a_setting(post):
    (sector,) = LidarConfig.model_validate({"ignore": body_sectors(with_posts(posts=(post,)))}).ignore
    hidden = is_in_sectors(LASER, ((post[0], post[1] - 0.5),))
    assert is_in_sectors(LASER, (sector,))[hidden].all()
    assert np.count_nonzero(is_in_sectors(LASER, (sector,))) <= np.count_nonzero(hidden) + 4


def test_the_radius_of_the_body_is_that_of_its_farthest_return():
    assert body_radius_m(SCANS, LASER) == 0.0
    assert body_radius_m(with_posts(posts=((0, 5),)), LASER) == pytest.approx(0.5, abs=0.01)
    assert body_radius_m(with_posts(posts=((180, 185),)), LASER) == pytest.approx(0.1, abs=0.01)


def test_walls_and_short_or_straight_drives_propose_nothing():
    assert body_sectors(SCANS) == ()
    assert body_sectors(with_posts()[:20]) == ()
    assert body_sectors([with_posts()[0]] * 100) == ()
    unknown = frozen((math.nan,) * 3)
    assert body_sectors(replace(scan, T_odom_base=unknown) for scan in with_posts()) == ()
    corridor = [replace(scan, T_odom_base=frozen((0.5 * k, 0.0, 0.0))) for k, scan in enumerate([with_posts()[0]] * 60)]
    assert body_sectors(corridor) == ()


@pytest.mark.parametrize("sector", [(170.0, -170.0), (170.0, 190.0), (-190.0, -170.0)])
def test_a_sector_goes_counter_clockwise_and_may_cross_the_back(sector):
    headings = np.degrees(LASER.angle_min_rad + LASER.angle_increment_rad * np.arange(360)) + 90.0
    off = np.abs(np.remainder(headings, 360.0) - 180.0)
    assert (is_in_sectors(LASER, (sector,)) == (off < 10.0 + 1e-9)).mean() > 0.99
    assert np.count_nonzero(is_in_sectors(LASER, ((sector[1], sector[0]),))) == pytest.approx(341, abs=2)


@pytest.mark.parametrize("sector", [(-180.0, 180.0), (0.0, 360.0), (-360.0, 10.0)])
def test_a_sector_of_a_turn_or_more_is_the_whole_turn(sector):
    assert is_in_sectors(LASER, (sector,)).all()


def test_beams_in_the_sectors_are_left_out_of_the_map():
    scan = with_posts()[0]
    mapped = MappedScans(((38.0, 48.0), (-5.0, 6.0), (128.0, 135.0))).of(scan)
    assert mapped.ranges_m[mapped.ranges_m > 0.0].min() > 0.31
    assert np.count_nonzero(mapped.ranges_m == 0.0) == pytest.approx(10 + 11 + 7 + 3, abs=3)
    kept = MappedScans().of(scan)
    assert np.array_equal(mapped.ranges_m[mapped.ranges_m > 0.0], kept.ranges_m[mapped.ranges_m > 0.0])


BODY = [[0.55, 0.22], [0.55, -0.22], [-0.11, -0.22], [0.0, 0.0], [-0.11, 0.22]]
"""A body with a notch at its back, by which the laser looks out."""


def test_returns_within_the_footprint_are_left_out_and_those_behind_it_are_not():
    """The posts are 0.3 m from a laser at (0.2, 0) that looks to the left."""
    scan = with_posts()[0]
    kept, mapped = MappedScans().of(scan), MappedScans(footprint=LidarConfig(footprint=BODY).footprint).of(scan)
    headings = LASER.angles_rad() + LASER.T_base_laser[2]
    x, y = 0.2 + kept.ranges_m * np.cos(headings), kept.ranges_m * np.sin(headings)
    is_body = (x < 0.55) & (np.abs(y) < 0.22) & (x > -0.11) & ((x > 0.0) | (np.abs(y) > -2.0 * x))
    assert 0 < np.count_nonzero(is_body) < np.count_nonzero(kept.ranges_m < 0.31)
    assert np.array_equal(mapped.ranges_m, np.where(is_body, 0.0, kept.ranges_m))


def test_a_footprint_says_nothing_about_beams_without_a_return():
    ranges_m = np.where(np.arange(360) < 300, np.inf, SCANS[0].ranges_m)
    some = replace(SCANS[0], ranges_m=frozen(ranges_m, np.float32))
    mapped = MappedScans(footprint=LidarConfig(footprint=BODY).footprint).of(some)
    assert np.array_equal(np.isposinf(mapped.ranges_m), np.isposinf(some.ranges_m))


def test_the_footprint_is_written_as_in_nav2():
    assert LidarConfig(footprint=str(BODY)) == LidarConfig(footprint=BODY)
    assert LidarConfig(footprint="[]") == LidarConfig()


@pytest.mark.parametrize(
    "corners",
    ["0.3,0.2 0.3,-0.2 -0.3,0.0", [[0.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], [[1.0, 2.0, 3.0]],
     [[0.0, 0.0], [1.0, 0.0], [0.0, math.nan]], [[0.0, 0.0], [99.0, 0.0], [0.0, 1.0]], 0.3],
)  # fmt: skip
def test_a_footprint_that_is_no_polygon_is_one_line(corners):
    with pytest.raises(InputError, match=r"^my\.yaml: footprint.*: [^\n]+ \(given: [^\n]+\)$"):
        parse(LidarConfig, {"footprint": corners}, "my.yaml")


def test_the_proposed_line_is_a_configuration(tmp_path):
    write_bag(tmp_path / "run.mcap", with_posts())
    (line,) = bodies_of(open_source(tmp_path / "run.mcap"))
    config = LidarConfig.model_validate(yaml.safe_load(line.split("configuration: ")[1])["robot"]["lidar"])
    hidden = is_in_sectors(LASER, tuple((first, last - 0.5) for first, last in POSTS_DEG))
    assert is_in_sectors(LASER, config.ignore)[hidden].all()
    with pytest.raises(ValidationError):
        LidarConfig.model_validate({"ignore": [[10.0, 400.0]]})
    with pytest.raises(ValidationError):
        LidarConfig.model_validate({"ignore": [10.0, 40.0]})
