"""Which topics a live robot reads, and what it says if there are none."""

import pytest

from fcslam.cli.addresses import RosAddress, parse_address
from fcslam.errors import InputError
from fcslam.ros.node import open_network
from fcslam.ros.topics import choose_sensor_topics
from fcslam.sources import BagOptions
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    MULTI_ECHO_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    SCAN,
    TRANSFORMS,
)
from tests.ros.memory_network import offered


def choose(*topics, namespace="/robot1", **options):
    return choose_sensor_topics([offered(*topic) for topic in topics], namespace, BagOptions(**options))


def test_topics_are_found_by_type_in_the_namespace():
    found = choose(
        ("/robot1/front/scan", SCAN), ("/robot1/a", SCAN), ("/robot2/scan", SCAN), ("/robot1/wheels", ODOMETRY),
        ("/robot1/ground_truth/odom", ODOMETRY), ("/tf", TRANSFORMS),
    )  # fmt: skip
    assert found.scans == ("/robot1/front/scan",)
    assert found.odometry == "/robot1/wheels"
    assert found.transforms == ("/tf", "/tf_static")
    assert found.camera is None
    assert found.notes == (
        "reads laser scans from /robot1/front/scan, not from /robot1/a (--sensors scan-topic chooses)",
    )


def test_laser_scans_go_before_point_clouds_and_these_before_depth_images():
    depth = (("/depth/image", IMAGE), ("/depth/camera_info", CAMERA_INFO))
    cloud, laser = ("/points", POINT_CLOUD), ("/z/lidar", SCAN)
    assert choose(*depth, cloud, laser, namespace="").scans == ("/z/lidar",)
    assert choose(*depth, cloud, namespace="").scans == ("/points",)
    found = choose(*depth, namespace="")
    assert (found.scans, found.camera) == (("/depth/image",), None)
    assert found.kinds["/depth/camera_info"] == CAMERA_INFO
    assert choose(cloud, laser, namespace="", scan_topics=("points",)).scans == ("/points",)


def test_in_3d_clouds_go_first_and_the_imu_is_read_beside_wheels():
    topics = ("/z", POINT_CLOUD), ("/points", POINT_CLOUD), ("/scan", SCAN), ("/odom", ODOMETRY), ("/imu", IMU)
    found = choose(*topics, namespace="", in_3d=True)
    assert (found.scans, found.odometry, found.imu, found.in_space) == (("/points",), "/odom", "/imu", True)
    assert choose(*topics, namespace="", in_3d=True, scan_topics=("/z",)).scans == ("/z",)
    laser = choose(*topics, namespace="", in_3d=True, scan_topics=("/scan",))
    assert (laser.scans, laser.imu, laser.in_space) == (("/scan",), None, False)
    assert choose(*topics[2:], namespace="", in_3d=True).scans == ("/scan",)


def test_tf_of_the_namespace_goes_before_that_of_all_robots():
    found = choose(("/robot1/scan", SCAN), ("/robot1/tf", TRANSFORMS), ("/tf", TRANSFORMS))
    assert found.transforms == ("/robot1/tf", "/tf_static")
    assert found.odometry is None


def test_a_calibrated_camera_is_read():
    found = choose(
        ("/scan", SCAN), ("/rgb/image_raw", IMAGE), ("/rgb/image_raw/compressed", COMPRESSED_IMAGE),
        ("/rgb/camera_info", CAMERA_INFO), ("/depth/image", IMAGE), ("/depth/camera_info", CAMERA_INFO), namespace="",
    )  # fmt: skip
    assert (found.camera, found.camera_info) == ("/rgb/image_raw/compressed", "/rgb/camera_info")


def test_named_topics_may_be_relative_or_of_tf():
    found = choose(
        ("/robot1/left", SCAN), ("/right", SCAN), ("/tf", TRANSFORMS), ("/robot1/odom", ODOMETRY),
        scan_topics=("left", "/right"), odom_topic="/tf",
    )  # fmt: skip
    assert found.scans == ("/robot1/left", "/right")
    assert found.odometry is None
    assert found.kinds == {"/robot1/left": SCAN, "/right": SCAN, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, r"no laser scans \(sensor_msgs/LaserScan\).* in /robot1; .* the topics are /robot1/odom \(nav_msgs/Odom"),
        (
            {"scan_topics": ("scan",)},
            r"topic /robot1/scan is not there; --sensors scan-topic needs sensor_msgs/LaserScan, sensor_msgs/Point",
        ),
        ({"scan_topics": ("odom",)}, r"topic /robot1/odom has the type nav_msgs/Odometry; --sensors scan-topic needs"),
    ],
)
def test_a_missing_topic_is_told_with_those_that_are_there(options, said):
    with pytest.raises(InputError, match=said):
        choose(("/robot1/odom", ODOMETRY), **options)


def test_an_empty_network_is_told():
    with pytest.raises(InputError, match="there are no topics"):
        choose()


def test_addresses():
    assert parse_address("ros2:/robot1") == RosAddress("ros2", "/robot1")
    assert parse_address("zenoh:/").namespace == parse_address("ros2:").namespace == ""
    assert parse_address("ros2:/fleet/anna/").robot == "anna"
    with pytest.raises(InputError, match="'robot1' is not a namespace; give one as in ros2:/robot1"):
        parse_address("ros2:robot1")


@pytest.mark.parametrize("domain", ["233", "-1"])
def test_a_domain_out_of_range(domain):
    with pytest.raises(InputError, match="is not a ROS 2 domain"):
        open_network("ros2", {"ROS_DOMAIN_ID": domain})


def test_a_topic_of_one_echo_a_beam_goes_before_one_of_several():
    echoes = [offered("/first", SCAN), offered("/echoes", MULTI_ECHO_SCAN), offered("/odom", ODOMETRY)]
    assert choose_sensor_topics(echoes, "", BagOptions()).scans == ("/first",)
    assert choose_sensor_topics(echoes[1:], "", BagOptions()).scans == ("/echoes",)
