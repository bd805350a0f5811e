"""Plays a recording as a real ROS 1 robot, with rospy of Debian. Arguments and answer are those of
rclpy_player.py; the recording holds the laser's mounting_x, too."""

import json
import sys
import time
from itertools import pairwise

import numpy as np

sys.path.append("/usr/lib/python3/dist-packages")  # where Debian has rospy

import rospy
import tf2_ros
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

LONGEST_WAIT_S = 90.0


def stamped(message, stamp, frame):
    message.header.stamp = rospy.Time(*divmod(round(stamp * 1e9), 10**9))
    message.header.frame_id = frame
    return message


class Driver:
    """The node of the robot's drivers."""

    def __init__(self, namespace):
        self.scans = rospy.Publisher(f"{namespace}/scan", LaserScan, queue_size=100)
        self.odometry = rospy.Publisher(f"{namespace}/odom", Odometry, queue_size=100)
        self.static = rospy.Publisher("/tf_static", TFMessage, queue_size=1, latch=True)
        self.poses, self.transforms = [], []
        rospy.Subscriber(f"{namespace}/pose", PoseWithCovarianceStamped, self.poses.append)
        rospy.Subscriber("/tf", TFMessage, self.transforms.append)
        self.buffer = tf2_ros.Buffer()
        self.listener = tf2_ros.TransformListener(self.buffer)

    def play(self, recording, speed):
        """Publish the odometry at the stamp of each scan, and the scan once all its beams are measured."""
        mounting = stamped(TransformStamped(), 1.0, "base_link")
        mounting.child_frame_id, mounting.transform.rotation.w = "laser", 1.0
        mounting.transform.translation.x = float(recording["mounting_x"])
        self.static.publish(TFMessage([mounting]))
        end = time.monotonic() + LONGEST_WAIT_S
        while time.monotonic() < end and not (self.scans.get_num_connections() and self.odometry.get_num_connections()):
            time.sleep(0.1)
        time.sleep(0.5)
        stamps, began = recording["stamps"], time.monotonic()
        laser, beam_s = recording["laser"].tolist(), float(recording["beam_s"])
        for stamp, ranges, pose in zip(stamps, recording["ranges"], recording["odometry"], strict=True):
            due, duration_s = began + (stamp - stamps[0]) / speed, beam_s * (len(ranges) - 1) / speed
            time.sleep(max(0.0, due - time.monotonic()))
            self.publish_odometry(stamp, pose)
            time.sleep(max(0.0, due + duration_s - time.monotonic()))
            self.publish_scan(stamp, ranges, laser, beam_s)
        end = time.monotonic() + 3.0
        while len(self.poses) < len(stamps) and time.monotonic() < end:
            time.sleep(0.05)

    def publish_odometry(self, stamp, pose):
        reading = stamped(Odometry(), stamp, "odom")
        reading.child_frame_id = "base_link"
        reading.pose.pose.position.x, reading.pose.pose.position.y = float(pose[0]), float(pose[1])
        reading.pose.pose.orientation.z = float(np.sin(pose[2] / 2))
        reading.pose.pose.orientation.w = float(np.cos(pose[2] / 2))
        self.odometry.publish(reading)

    def publish_scan(self, stamp, ranges, laser, beam_s):
        scan = stamped(LaserScan(), stamp, "laser")
        scan.angle_min, scan.angle_increment, scan.range_max = laser
        scan.angle_max = scan.angle_min + scan.angle_increment * (len(ranges) - 1)
        scan.time_increment = beam_s
        scan.ranges = ranges.tolist()
        self.scans.publish(scan)

    def look(self, newest, namespace):
        """Return the transforms of tf2 after the last scan, and the responses of the services."""
        time.sleep(2.0)  # longer than map -> odom goes on after the last scan
        stamps = [message.transforms[0].header.stamp.to_nsec() for message in self.transforms]
        return {
            "transforms": len(stamps),
            "is_monotone": all(a < b for a, b in pairwise(stamps)),
            "is_known": [self.is_known(newest + later) for later in (0.0, 1.0, 1.5)],
            "saved": rospy.ServiceProxy(f"{namespace}/fcslam/save_map", Trigger)().message,
            "finished": rospy.ServiceProxy(f"{namespace}/fcslam/finish", Trigger)().message,
        }

    def is_known(self, stamp):
        """Whether tf2 has ``map -> odom`` at this time, as navigation asks for it."""
        try:
            self.buffer.lookup_transform("map", "odom", rospy.Time(*divmod(round(stamp * 1e9), 10**9)))
        except tf2_ros.ExtrapolationException:
            return False
        return True


def main(path, namespace, speed):
    recording = np.load(path)
    rospy.init_node("driver", disable_signals=True)
    driver = Driver(namespace)
    driver.play(recording, speed)
    maps, paths = [], []
    asked = time.monotonic()
    rospy.Subscriber(f"{namespace}/map", OccupancyGrid, maps.append)
    rospy.Subscriber(f"{namespace}/path", Path, paths.append)
    while not (maps and paths) and time.monotonic() < asked + 10.0:
        time.sleep(0.02)
    map_s = time.monotonic() - asked
    answer = {"played": len(recording["stamps"]), "posed": len(driver.poses)}
    if driver.poses:
        answer |= driver.look(recording["stamps"][-1], namespace)
    if maps:
        grid = maps[-1]
        answer |= {"map_s": map_s, "frame": grid.header.frame_id, "values": sorted(set(grid.data))}
        answer |= {"width": grid.info.width, "height": grid.info.height}
    answer["path"] = len(paths[-1].poses) if paths else 0
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
