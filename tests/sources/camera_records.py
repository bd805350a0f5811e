"""Records of a robot with a laser and a camera, made without any of the code under test."""

import math

import cv2
import numpy as np

from fcslam.records import CameraImage, CameraModel, LaserModel, LaserScan, Odometry, Transform, frozen

LASER = LaserModel(12, -math.pi, math.tau / 12, 12.5, (-0.1, 0.05, 0.4))
CAMERA = CameraModel(8, 6, 7.25, 7.5, 3.5, 2.5, Transform((0.1, -0.02, 0.3), (-0.5, 0.5, -0.5, 0.5)))


def png(width=CAMERA.width, height=CAMERA.height, shade=0):
    """A grey PNG."""
    return cv2.imencode(".png", np.full((height, width), shade, np.uint8))[1].tobytes()


def image(stamp, pose=None, encoded=None, camera=CAMERA):
    return CameraImage(stamp, png() if encoded is None else encoded, camera, None if pose is None else frozen(pose))


def scan(stamp, pose=(0.0, 0.0, 0.0), ranges=2.0):
    return LaserScan(stamp, frozen(np.full(LASER.beam_count, ranges), np.float32), LASER, frozen(pose))


def drive(count=20, start=100.0):
    """Odometry, a scan and an image at each of ``count`` places."""
    records = []
    for k in range(count):
        stamp, pose = start + 0.25 * k, (0.125 * k, 0.0, 0.0)
        records.append(Odometry(stamp, frozen(pose)))
        records.append(scan(stamp, pose))
        records.append(image(stamp, pose, png(shade=k % 256)))
    return records


def same(before, after):
    """Whether two records are equal to the last bit."""
    if type(before) is not type(after) or before.stamp != after.stamp:
        return False
    poses = [None if r.T_odom_base is None else r.T_odom_base.tobytes() for r in (before, after)]
    if poses[0] != poses[1]:
        return False
    measured = ("laser", "sweep", "camera", "encoded")
    sensed = all(getattr(before, name, None) == getattr(after, name, None) for name in measured)
    return sensed and (not isinstance(before, LaserScan) or before.ranges_m.tobytes() == after.ranges_m.tobytes())
