"""Reads a ROS bag: plans what is read of it, surveys it once, then streams its records.

Scans come in the order of recording, with the odometry at their own header stamps. Damaged messages are skipped and
counted. A robot that stands still is accepted, because a topic shows that there is odometry.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain, repeat
from pathlib import Path
from typing import NamedTuple

from fcslam.errors import InputError, SourceError
from fcslam.records import GnssFix, Odometry, SensorRecord, frozen
from fcslam.sources.bags.census import DecodedBag, Messages, valid
from fcslam.sources.bags.container import is_transforms
from fcslam.sources.bags.imu import ImuReading
from fcslam.sources.bags.messages import OdometryReading
from fcslam.sources.bags.options import BagCorrection, BagOptions
from fcslam.sources.bags.pairing import PosedScan
from fcslam.sources.bags.plan import BagPlan, plan_of
from fcslam.sources.bags.reader import Numbered, SensorReader
from fcslam.sources.bags.rig import Rig
from fcslam.sources.bags.robots import BagRobot, robot_of, robots_of, slashed
from fcslam.sources.bags.transforms import NoTransformError
from fcslam.sources.contradictions import ScanWatch
from fcslam.sources.faults import Audit, Fault, Faults
from fcslam.sources.gate import check_consistency
from fcslam.sources.path_summary import PathSummary
from fcslam.sources.returns import RangeSample, placeholder_note, without
from fcslam.sources.source import Survey

_audit = partial(Audit, "message")
_OF_SCANS = "its range_min and range_max"
_OF_CLOUDS = "that a cloud is a whole turn, its points are in metres, its mounting in tf and the heights of cloud-band"


class _Reading(NamedTuple):
    survey: Survey
    rig: Rig
    placeholders: tuple[tuple[float, ...], ...]


class RosBag:
    """A bag of one robot."""

    def __init__(
        self,
        path: Path,
        name: str,
        options: BagOptions | None = None,
        notes: tuple[str, ...] = (),
        robot: BagRobot | None = None,
    ) -> None:
        """``notes`` say what was chosen for this bag before; ``robot`` is one of several in it."""
        self.name = name
        self.path = path
        self._notes = notes
        self.options = options or BagOptions()
        self.bag: Messages = DecodedBag(path) if robot is None else robot.bag
        self._given_robot = robot
        self._audit = _audit()

    @cached_property
    def robot(self) -> BagRobot:
        """The robot whose topics are read."""
        return self._given_robot or robot_of(self.bag, self.options)

    @cached_property
    def plan(self) -> BagPlan:
        """What is read, and how."""
        return self.planned(self.options)

    def planned(self, options: BagOptions) -> BagPlan:
        """A plan by other options."""
        with self._translated():
            return plan_of(self.robot, options)

    @contextmanager
    def _translated(self, errors: Mapping[str, str] | None = None) -> Iterator[None]:
        """Translate errors of mountings to SourceError; ``errors`` are those of messages."""
        try:
            yield
        except NoTransformError as error:
            each = " for each laser" * (len(self.options.scan_topics) > 1)
            raise SourceError(
                f"{self.path}: tf has {error}{_in_brackets(errors or {})}; give it with --sensors "
                f"laser-pose=X,Y,THETA (metres, radians){each}; if it is in another part of this recording, give both "
                "joined by a comma"
            ) from error
        except SourceError:
            raise
        except InputError as error:
            raise SourceError(f"{self.path}: {error}") from error

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._audit.faults()

    def survey(self) -> Survey:
        """As in Source; the pass over the bag is made once."""
        return self._reading.survey

    def records(self) -> Iterator[SensorRecord]:
        """As in Source."""
        audit = self._audit = _audit()
        watch = ScanWatch(audit)
        rig, placeholders = self._reading.rig, self._reading.placeholders
        correction = self.options.correction
        sign = -1.0 if correction.upside_down else 1.0
        floors = [floor and floor._replace(heading_rad=sign * floor.heading_rad) for floor in correction.floors]
        found, faults = self._fixes
        fixes = deque(found)
        for kind, fault in faults.counts.items():
            audit.add(kind, fault.first_line, fault.count)
        for number, entry in self._entries(audit, {}, with_images=rig.camera is not None, imu=self._imu):
            if isinstance(entry, PosedScan):
                record = rig.scan(entry)
                while fixes and fixes[0].stamp <= record.stamp:
                    yield fixes.popleft()
                if values := placeholders[entry.scan.laser]:
                    record = replace(record, ranges_m=without(record.ranges_m, values))
                if floors and (floor := floors[entry.scan.laser]) is not None:
                    record = floor.left_out(record)
                watch.add(number, record)
                yield record
            elif isinstance(entry, OdometryReading):
                yield Odometry(entry.stamp, frozen(entry.T_odom_base))
            else:
                try:
                    yield rig.image(entry)
                except ValueError:
                    audit.add(Fault.BROKEN_IMAGE, number)

    @cached_property
    def _imu(self) -> list[ImuReading]:
        """The readings of the IMU of a robot without odometry."""
        if self.plan.imu is None:
            return []
        items = chain.from_iterable(valid(self.bag.read([self.plan.imu]), self.plan.items))
        return sorted(item for item in items if isinstance(item, ImuReading))

    @cached_property
    def _fixes(self) -> tuple[tuple[GnssFix, ...], Faults]:
        audit, plan = _audit(), self.plan
        messages = self.bag.read([] if plan.fixes is None else [plan.fixes])
        found = chain.from_iterable(map(plan.fix_reader(audit).read, messages))
        return tuple(sorted(found, key=lambda fix: fix.stamp)), audit.faults()

    def _entries(
        self, audit: Audit, errors: dict[str, str], with_images: bool = False, imu: Iterable[ImuReading] = ()
    ) -> Iterator[Numbered]:
        plan = self.plan
        reader = SensorReader(plan.lasers, plan.odometry is not None, audit, imu)
        for number, item in plan.read(self.bag.read(plan.read_topics(with_images)), audit, errors):
            yield from reader.add(number, item)
        yield from reader.finish()

    @cached_property
    def _reading(self) -> _Reading:
        audit, errors, plan = _audit(), dict[str, str](), self.plan
        lasers = plan.lasers
        scans, odometry = PathSummary(), PathSummary()
        samples = [RangeSample(laser.topic.message_count) for laser in lasers]
        farthest_m = [laser.first.range_max_m for laser in lasers]
        for topic in plan.topics.transforms:
            census = self.bag.census[topic]
            if census.broken and topic not in (plan.odometry.topics if plan.odometry else ()):
                errors[topic.name] = f"message {census.first_broken} of it: {census.error}"
                audit.add(Fault.BROKEN_MESSAGE, census.first_broken, census.broken)
        for _, entry in self._entries(audit, errors):
            if isinstance(entry, PosedScan):
                scan, pose = entry.scan, entry.T_odom_base
                farthest_m[scan.laser] = max(farthest_m[scan.laser], scan.range_max_m)
                samples[scan.laser].add(pose, scan.raw_ranges_m, scan.range_min_m, scan.range_max_m)
                scans.add(scan.stamp, pose)
            elif isinstance(entry, OdometryReading):
                odometry.add(entry.stamp, entry.T_odom_base)
        self._refuse(audit.faults(), scans, odometry, errors)
        which = [f" of {laser.name}" for laser in lasers]
        for sample, its, recorded in zip(samples, which, lasers, strict=True):
            if problem := sample.problem(its, _OF_CLOUDS if recorded.is_level else _OF_SCANS):
                raise SourceError(f"{self.path}: {problem}")
        placeholders = tuple(sample.placeholders() for sample in samples)
        with self._translated(errors):
            rig, rig_notes = plan.rig(farthest_m)
        notes = (
            *self._notes,
            *self.bag.notes,
            *self.unstamped(plan),
            *chain.from_iterable(laser.notes(self.path, self.options.cloud_band) for laser in lasers),
            *plan.scans.notes,
            *chain.from_iterable(map(placeholder_note, repeat(self.path), placeholders, which)),
            *self.robot.notes,
            *plan.topics.notes,
            *plan.notes,
            *(f"{self.path}: {note}" for note in rig_notes),
        )
        survey = Survey(scans.count, scans.duration_s, scans.length_m, rig.lasers, audit.faults(), notes, rig.camera)
        return _Reading(survey, rig, placeholders)

    def unstamped(self, plan: BagPlan) -> Iterator[str]:
        """The topics of which messages have no stamp, a sentence each."""
        for topic in sorted(plan.read_topics()):
            its = self.bag.census[topic]
            if its.unstamped > 1 and not is_transforms(topic):
                said = f"{its.unstamped} of {its.count} messages of {topic.name} have no stamp"
                yield f"{self.path}: {said}; their times of recording count"

    def _refuse(self, faults: Faults, scans: PathSummary, odometry: PathSummary, errors: Mapping[str, str]) -> None:
        path, topics, (laser, *_) = self.path, self.plan.topics, self.plan.lasers
        check_consistency(path, faults, scans.count, odometry.count, _in_brackets(errors))
        alone = faults[Fault.NO_ODOMETRY].count
        if alone > scans.count:
            raise SourceError(
                f"{path}: {alone} of {alone + scans.count} scans in {laser.topic.name} have no odometry within 1 s: "
                f"message {faults[Fault.NO_ODOMETRY].first_line} is the first. The first scan has the stamp "
                f"{laser.first.stamp:.3f} s, {topics.odometry[0].name} goes from {odometry.earliest:.3f} s to "
                f"{odometry.latest:.3f} s; record both by one clock, all the way, or map without odometry by --sensors "
                "odom-topic=none"
            )

    @property
    def is_upside_down(self) -> bool:
        """Whether the first laser is."""
        return self._reading.rig.upside_down[0]

    def corrected(self, correction: BagCorrection, notes: tuple[str, ...]) -> "RosBag":
        """The same bag, read with a correction that ``notes`` explain; the floors of an earlier one stay left out.

        A mounting that the user gives is never corrected.
        """
        if self.options.laser_poses:
            correction = replace(correction, mounting=(0.0, 0.0, 0.0), upside_down=False)
        correction = replace(correction, floors=correction.floors or self.options.correction.floors)
        options = replace(self.options, correction=correction)
        return RosBag(self.path, self.name, options, (*self._notes, *notes), self.robot)

    def without_body(self, radius_m: float) -> "RosBag":
        """The same bag without the points of clouds that are nearer to the base, as they are of the robot."""
        options = replace(self.options, cloud_band=self.options.cloud_band._replace(body_radius_m=radius_m))
        note = f"{self.path}: points up to {radius_m:.2f} m from the base belong to the robot and are left out"
        return RosBag(self.path, self.name, options, (*self._notes, note), self.robot)

    def robots(self, name: str | None = None) -> "list[RosBag]":
        """The robots of the bag, or the one that is chosen, named as in it; ``name`` stands for the bag."""
        robots = robots_of(self.bag, self.options)
        if self.options.robot is not None or len(robots) == 1:
            return [self]
        return [self._of(robot, name) for robot in robots]

    def _of(self, robot: BagRobot, name: str | None) -> "RosBag":
        options, own = self.options, {slashed(topic.name) for topic in robot.topics}
        lasers = [k for k, topic in enumerate(options.scan_topics) if slashed(topic) in own]
        if options.scan_topics:
            poses = tuple(pose for k in lasers for pose in options.laser_poses[k : k + 1])
            topics = tuple(options.scan_topics[k] for k in lasers)
            options = replace(options, scan_topics=topics, laser_poses=poses)
        called = "_".join(filter(None, (name, robot.name.strip("/").replace("/", "_")))) or self.name
        return RosBag(self.path, called, options, self._notes, robot)


def _in_brackets(errors: Mapping[str, str]) -> str:
    return f" ({'; '.join(f'{topic}, {error}' for topic, error in errors.items())})" * bool(errors)
