"""Plays a recording as a real ROS 2 robot, and afterwards subscribes to its map as Nav2 does; runs with rclpy.

    python rclpy_player.py SCANS.npz NAMESPACE SPEED

The file holds stamps (N,), ranges (N, B), odometry (N, 3), laser (angle_min, angle_increment, range_max), and beam_s,
the time between two beams. At the end it prints one line of JSON: what it played and what it saw.
"""

import json
import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Empty

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LONGEST_WAIT_S, LONGEST_LOOK_S = 90.0, 10.0


def stamped(message, stamp, frame):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
    message.header.frame_id = frame
    return message


def faults_of(grid):
    """Why the static layer of a costmap of Nav2, which checks a map first, would reject it or misplace it."""
    info, at, turn = grid.info, grid.info.origin.position, grid.info.origin.orientation
    if grid.header.frame_id != "map":
        yield f"frame {grid.header.frame_id}"
    if not 0 <= grid.header.stamp.nanosec < 10**9 or grid.header.stamp.sec < 0:
        yield "stamp"
    if not (0 < info.width < 2**15 and 0 < info.height < 2**15 and len(grid.data) == info.width * info.height):
        yield f"{info.width} x {info.height} cells, {len(grid.data)} values"
    if not (np.isfinite(info.resolution) and info.resolution > 1e-6):
        yield f"resolution {info.resolution}"
    if not np.isfinite((at.x, at.y, at.z)).all() or (turn.x, turn.y, turn.z, turn.w) != (0.0, 0.0, 0.0, 1.0):
        yield f"origin {at} {turn}"  # a costmap ignores a turn
    if not set(grid.data) <= set(range(-1, 101)):
        yield "values"


class Driver:
    """The node of the robot's drivers."""

    def __init__(self, namespace):
        self.node = rclpy.create_node("driver")
        self.scans = self.node.create_publisher(LaserScan, f"{namespace}/scan", qos_profile_sensor_data)
        self.odometry = self.node.create_publisher(Odometry, f"{namespace}/odom", 10)
        self.finish = self.node.create_publisher(Empty, f"{namespace}/fcslam/finish", 10)
        self.posed, self.sent, self.faults = 0, set(), set()
        self.node.create_subscription(PoseWithCovarianceStamped, f"{namespace}/pose", self.saw, 100)
        self.node.create_subscription(OccupancyGrid, f"{namespace}/map", self.mapped, LATCHED)

    def mapped(self, grid):
        self.faults |= set(faults_of(grid))

    def saw(self, pose):
        stamp_ns = pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec
        near = min(self.sent, key=lambda known: abs(known - stamp_ns), default=None)
        if near is not None and abs(near - stamp_ns) < 1000:
            self.posed += 1
            self.sent.remove(near)

    def spin_while(self, condition, longest_s):
        end = time.monotonic() + longest_s
        while condition() and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def play(self, recording, speed):
        """Publish the odometry at the stamp of each scan, and the scan once all its beams are measured."""
        self.spin_while(
            lambda: not (self.scans.get_subscription_count() and self.odometry.get_subscription_count()), LONGEST_WAIT_S
        )
        time.sleep(0.5)
        stamps, began = recording["stamps"], time.monotonic()
        laser, beam_s = recording["laser"].tolist(), float(recording["beam_s"])
        for stamp, ranges, pose in zip(stamps, recording["ranges"], recording["odometry"], strict=True):
            due, duration_s = began + (stamp - stamps[0]) / speed, beam_s * (len(ranges) - 1) / speed
            self.spin_while(lambda due=due: time.monotonic() < due, LONGEST_WAIT_S)
            self.publish_odometry(stamp, pose)
            self.spin_while(lambda due=due + duration_s: time.monotonic() < due, LONGEST_WAIT_S)
            self.publish_scan(stamp, ranges, laser, beam_s)
        self.spin_while(lambda: self.sent, LONGEST_WAIT_S)

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
        self.sent.add(round(stamp * 1e9))
        self.scans.publish(scan)


def look(namespace):
    """Subscribe late, as a Nav2 that starts now; returns the maps and the paths that came."""
    maps, paths = [], []
    context = Context()
    context.init()
    with context:
        node = rclpy.create_node("navigation", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        asked = time.monotonic()
        node.create_subscription(OccupancyGrid, f"{namespace}/map", maps.append, LATCHED)
        node.create_subscription(Path, f"{namespace}/path", paths.append, LATCHED)
        while not (maps and paths) and time.monotonic() < asked + LONGEST_LOOK_S:
            executor.spin_once(0.02)
    return maps, paths


def main(path, namespace, speed):
    recording = np.load(path)
    rclpy.init()
    driver = Driver(namespace)
    driver.play(recording, speed)
    maps, paths = look(namespace)
    driver.finish.publish(Empty())
    time.sleep(0.5)
    answer = {"played": len(recording["stamps"]), "posed": driver.posed}
    for grid in maps[-1:]:
        answer |= {"frame": grid.header.frame_id, "values": sorted(set(grid.data))}
        answer["faults"] = sorted(driver.faults.union(faults_of(grid)))
    answer["path"] = len(paths[-1].poses) if paths else 0
    sys.stdout.write(json.dumps(answer) + "\n")
    rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
