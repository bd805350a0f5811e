"""Reads the point clouds of a ROS bag whole, for a robot with a 3D LiDAR, with its wheels and its IMU."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import chain

from fcslam.records import CloudScan
from fcslam.sources.bags.census import valid
from fcslam.sources.bags.codec import CLOUDS
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.plan import BagPlan
from fcslam.sources.bags.reader import CloudStream
from fcslam.sources.bags.robots import slashed
from fcslam.sources.bags.rosbag import RosBag
from fcslam.sources.clouds_in_space import BAND_LASER, CloudReader, CloudRecording
from fcslam.sources.faults import Audit
from fcslam.sources.path_summary import PathSummary
from fcslam.sources.source import Source, Survey


class CloudBag(CloudRecording):
    """The clouds of one robot in a bag."""

    def __init__(self, bag: RosBag, topic: Topic) -> None:
        """``topic`` has the clouds."""
        super().__init__(bag.path, bag.name, "message")
        self._bag, self._topic = bag, topic

    @cached_property
    def _plan(self) -> BagPlan:
        return self._bag.planned(replace(self._bag.options, scan_topics=(self._topic.name,)))

    @cached_property
    def _reader(self) -> tuple[CloudReader, tuple[str, ...]]:
        return self._plan.scans.whole_reader(self._topic)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Lines that say what is read, and what is wrong with the clouds."""
        plan, (reader, notes) = self._plan, self._reader
        topics = ", ".join(topic.name for topic in plan.read_topics(with_imu=True))
        return f"--3d reads {topics}{', with times' * reader.is_timed}", *notes

    def survey(self) -> Survey:
        """As in ``CloudRecording``."""
        _, notes = self._reader
        plan, track = self._plan, PathSummary()
        if plan.odometry is not None:
            readings = valid(self._bag.bag.read(plan.odometry.topics), plan.odometry.readings)
            for reading in chain.from_iterable(readings):
                track.add(reading.stamp, reading.T_odom_base)
        first_ns, last_ns = self._bag.bag.census[self._topic].span_ns
        found = *self._bag.bag.notes, *self._bag.unstamped(plan)
        notes = (*found, *notes, *self._bag.robot.notes, *plan.scans.notes, *plan.notes)
        count, duration_s = self._topic.message_count, (last_ns - first_ns) * 1e-9
        return Survey(count, duration_s, track.length_m, (BAND_LASER,), self._audit.faults(), notes)

    def _scans(self, audit: Audit) -> Iterator[tuple[int, CloudScan]]:
        plan, (reader, _) = self._plan, self._reader
        stream = CloudStream(reader, audit)
        for number, item in plan.read(self._bag.bag.read(plan.read_topics(with_imu=True)), audit, {}):
            yield from stream.add(number, item)
        yield from stream.finish()


def in_3d(bag: RosBag) -> Source:
    """The same recording with its clouds read whole, if it has any; else as it is, for a robot with a 2D laser."""
    wanted = set(map(slashed, bag.options.scan_topics))
    clouds = (topic for topic in bag.robot.of_type(*CLOUDS) if not wanted or slashed(topic.name) in wanted)
    best = next(clouds, None)
    return bag if best is None else CloudBag(bag, best)
