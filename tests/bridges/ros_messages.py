"""Messages of a robot with one laser, by the project's codec."""

import math

import numpy as np

from fcslam.sources.bags.codec import ODOMETRY, SCAN, TRANSFORMS, MessageCodec
from fcslam.sources.bags.transforms import in_space

CODEC = MessageCodec(ros1=False)
LASER_POSE = (0.2, 0.0, 0.1)


def header(stamp, frame):
    return CODEC.header(round(stamp * 1e9), frame)


def scan(stamp, ranges, frame="laser", angle_min=-math.pi / 2, increment=math.pi / 180, range_max=20.0):
    ranges = np.asarray(ranges, np.float32)
    return CODEC.make(
        SCAN, header=header(stamp, frame), angle_min=angle_min, angle_max=angle_min + increment * (len(ranges) - 1),
        angle_increment=increment, time_increment=0.0, scan_time=0.1, range_min=0.1, range_max=range_max, ranges=ranges,
        intensities=np.zeros(0, np.float32),
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


def transform(stamp, parent, child, pose=LASER_POSE):
    return CODEC.transforms(header(stamp, parent), child, in_space(np.array(pose)))


def encoded(kind, message):
    return CODEC.encode(message, kind)


KINDS = {"/scan": SCAN, "/odom": ODOMETRY, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS}
