"""Messages of a robot with one laser, by the project's codec."""

import math

import numpy as np

from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    FIX,
    IMAGE,
    IMU,
    ODOMETRY,
    SCAN,
    TRANSFORMS,
    MessageCodec,
)
from fcslam.sources.bags.transforms import in_space

CODEC = MessageCodec(ros1=False)
LASER_POSE = (0.2, 0.0, 0.1)


def header(stamp, frame):
    return CODEC.header(round(stamp * 1e9), frame)


def scan(stamp, ranges, frame="laser", angle_min=-math.pi / 2, increment=math.pi / 180, range_max=20.0, beam_s=0.0):
    ranges = np.asarray(ranges, np.float32)
    return CODEC.make(
        SCAN, header=header(stamp, frame), angle_min=angle_min, angle_max=angle_min + increment * (len(ranges) - 1),
        angle_increment=increment, time_increment=beam_s, scan_time=max(0.1, beam_s * len(ranges)), range_min=0.1,
        range_max=range_max, ranges=ranges, intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def odometry(stamp, pose, frame="odom", child="base_link"):
    make, vector = CODEC.make, CODEC.vector
    posed = make("geometry_msgs/PoseWithCovariance", pose=CODEC.pose(in_space(np.array(pose))), covariance=np.zeros(36))
    twist = make(
        "geometry_msgs/TwistWithCovariance",
        twist=make("geometry_msgs/Twist", linear=vector("Vector3"), angular=vector("Vector3")),
        covariance=np.zeros(36),
    )
    return make(ODOMETRY, header=header(stamp, frame), child_frame_id=child, pose=posed, twist=twist)


def transform(stamp, parent, child, pose=LASER_POSE, height_m=0.0):
    flat = in_space(np.array(pose))
    at = flat._replace(translation_m=(*flat.translation_m[:2], height_m))
    return CODEC.transforms(header(stamp, parent), child, at)


def image(stamp, width=8, height=6):
    data = np.zeros(width * height, np.uint8)
    return CODEC.make(
        IMAGE, header=header(stamp, "camera"), height=height, width=width, encoding="mono8", is_bigendian=0, step=width,
        data=data,
    )  # fmt: skip


def camera_info(stamp, width=8, height=6):
    region = CODEC.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    K = np.array((5.0, 0, 4.0, 0, 5.0, 3.0, 0, 0, 1.0))
    return CODEC.make(
        CAMERA_INFO, header=header(stamp, "camera"), height=height, width=width, distortion_model="plumb_bob",
        d=np.zeros(5), k=K, r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip


def fix(stamp, latitude, longitude, frame="gnss"):
    status = CODEC.make("sensor_msgs/NavSatStatus", status=0, service=1)
    return CODEC.make(
        FIX, header=header(stamp, frame), status=status, latitude=latitude, longitude=longitude, altitude=400.0,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip


def imu(stamp, rate_rad_s, frame="imu"):
    return CODEC.make(
        IMU, header=header(stamp, frame), orientation=CODEC.rotation(in_space(np.zeros(3))),
        orientation_covariance=np.zeros(9), angular_velocity=CODEC.vector("Vector3", z=rate_rad_s),
        angular_velocity_covariance=np.zeros(9), linear_acceleration=CODEC.vector("Vector3", z=9.81),
        linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def encoded(kind, message):
    return CODEC.encode(message, kind)


KINDS = {"/scan": SCAN, "/odom": ODOMETRY, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS}
