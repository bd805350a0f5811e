"""Messages of a robot with one laser, as objects of rosbags."""

import math

import numpy as np

from fcslam.sources.bags.codec import CAMERA_INFO, FIX, IMAGE, IMU, ODOMETRY, SCAN, TRANSFORMS
from tests.sources import bag_messages
from tests.sources.bag_messages import CODECS, header, message_of, quaternion, tf

CODEC = CODECS[False]
LASER_POSE = (0.2, 0.0, 0.1)


def scan(stamp, ranges, frame="laser", angle_min=-math.pi / 2, increment=math.pi / 180, range_max=20.0, beam_s=0.0):
    angles = {"angle_min": angle_min, "angle_increment": increment, "time_increment": beam_s}
    return message_of(bag_messages.scan(stamp, ranges, frame=frame, range_max=range_max, **angles))


def odometry(stamp, pose, frame="odom", child="base_link"):
    return message_of(bag_messages.odom(stamp, pose, child=child, parent=frame))


def transform(stamp, parent, child, pose=LASER_POSE, height_m=0.0):
    x, y, theta = pose
    return message_of(tf(stamp, parent, child, (x, y, height_m), quaternion(theta)))


def image(stamp, width=8, height=6):
    size, data = {"width": width, "height": height, "step": width}, np.zeros(width * height, np.uint8)
    return CODEC.make(IMAGE, header=header(stamp, "camera"), **size, encoding="mono8", data=data)


def camera_info(stamp, width=8, height=6):
    K = np.array((5.0, 0, 4.0, 0, 5.0, 3.0, 0, 0, 1.0))
    return CODEC.make(CAMERA_INFO, header=header(stamp, "camera"), height=height, width=width, k=K)


def fix(stamp, latitude, longitude, frame="gnss"):
    return CODEC.make(FIX, header=header(stamp, frame), latitude=latitude, longitude=longitude, altitude=400.0)


def imu(stamp, rate_rad_s, frame="imu"):
    turn, force = CODEC.vector("Vector3", z=rate_rad_s), CODEC.vector("Vector3", z=9.81)
    return CODEC.make(IMU, header=header(stamp, frame), angular_velocity=turn, linear_acceleration=force)


def encoded(kind, message):
    return CODEC.encode(message, kind)


KINDS = {"/scan": SCAN, "/odom": ODOMETRY, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS}
