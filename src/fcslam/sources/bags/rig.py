"""The mounted sensors of a robot: they turn its messages into records."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import degrees, hypot, radians
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fcslam.errors import InputError
from fcslam.records import Beams, CameraImage, CameraModel, LaserModel, LaserScan, frozen
from fcslam.sources.bags.camera import check_image
from fcslam.sources.bags.codec import LASER_SCANS
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import UNKNOWN_RANGE_M, ScanMessage, measured_ranges, reversed_sweep
from fcslam.sources.bags.options import GivenPose
from fcslam.sources.bags.pairing import PosedImage, PosedScan
from fcslam.sources.bags.sectors import are_sectors, joined_turns
from fcslam.sources.bags.transforms import Mounting, NoTransformError, TransformTree, mounting
from fcslam.sources.gate import usual_beams
from fcslam.sources.point_clouds import CloudBand

_STEEPEST_RAD = radians(10.0)
FARTHEST_SENSOR_M = 10.0
"""Largest distance of a sensor from the base of a robot; a pose in millimetres or centimetres says more."""


class RecordedLaser(NamedTuple):
    """A laser or a sensor of clouds, by its first scans."""

    topic: Topic
    first: ScanMessage
    """The first scan with its usual beams."""
    is_in_sectors: bool
    frame: str | None = None
    """Frame of its scans, on a topic with several; None: any."""

    @property
    def name(self) -> str:
        """The topic, and the frame if it has several."""
        return self.topic.name if self.frame is None else f"{self.topic.name} in '{self.frame}'"

    @property
    def is_level(self) -> bool:
        """Whether its scans are level however it is mounted, as they are made of points."""
        return self.topic.type not in LASER_SCANS

    def notes(self, path: Path, band: CloudBand) -> Iterator[str]:
        """How its messages become scans, if they are none."""
        if self.is_in_sectors:
            yield f"{path}: the scans of {self.name} are sectors of a turn, those of each turn are joined"
        if self.is_level:
            yield (
                f"{path}: the scans of {self.name} are its nearest points from {band.low_m:g} m to {band.high_m:g} m "
                "above the floor (--sensors cloud-band chooses)"
            )


class Rig(NamedTuple):
    """Lasers and camera of a robot."""

    lasers: tuple[LaserModel, ...]
    upside_down: tuple[bool, ...]
    camera: CameraModel | None

    def scan(self, posed: PosedScan) -> LaserScan:
        """The record of a scan."""
        scan, upside_down = posed.scan, self.upside_down[posed.scan.laser]
        if scan.ranges_at_stamp is not None and scan.sweep is not None:
            scan = scan._replace(raw_ranges_m=scan.ranges_at_stamp(scan.sweep), sweep=None)
        ranges_m = measured_ranges(scan)
        ranges_m = frozen(ranges_m[::-1] if upside_down else ranges_m, np.float32)
        laser = self.lasers[scan.laser].with_beams(turned_beams(scan.beams, upside_down))
        sweep = reversed_sweep(scan.sweep) if upside_down else scan.sweep
        return LaserScan(scan.stamp, ranges_m, laser, frozen(posed.T_odom_base), sweep, gyro=posed.gyro)

    def widened(self, scan: ScanMessage) -> "Rig":
        """The rig in which a laser whose range_max grows has none of its own: that of each message counts."""
        laser = self.lasers[scan.laser]
        if scan.range_max_m <= laser.max_range_m:
            return self
        lasers = list(self.lasers)
        lasers[scan.laser] = replace(laser, max_range_m=UNKNOWN_RANGE_M)
        return self._replace(lasers=tuple(lasers))

    def image(self, posed: PosedImage) -> CameraImage:
        """The record of an image; raises ValueError if it is damaged, or of another camera, or there is none."""
        if self.camera is None:
            raise ValueError("no camera")
        check_image(posed.image.encoded, self.camera)
        pose = posed.T_odom_base
        return CameraImage(posed.image.stamp, posed.image.encoded, self.camera, None if pose is None else frozen(pose))


def recorded_laser(topic: Topic, first: Sequence[ScanMessage], frame: str | None = None) -> RecordedLaser:
    """The laser of these first scans."""
    is_in_sectors = are_sectors(first)
    turns = joined_turns(first) if is_in_sectors else first
    usual = usual_beams([scan.beams for scan in turns])
    return RecordedLaser(topic, next(scan for scan in turns if scan.beams == usual), is_in_sectors, frame)


def mountings_of(
    lasers: Sequence[RecordedLaser], tree: TransformTree, base_frame: str, poses: Sequence[GivenPose]
) -> list[Mounting]:
    """Where the lasers sit: where the user says, or else where tf says.

    Raises:
        NoTransformError: tf does not say it, yet.
        InputError: a laser cannot be read as it is mounted.
    """
    if poses:
        return [
            Mounting((x, y, theta), upside_down=any(upside_down) and not laser.is_level, tilt_rad=0.0)
            for (x, y, theta, *upside_down), laser in zip(poses, lasers, strict=True)
        ]
    topic_of: dict[str, str] = {}
    for laser in lasers:
        name, frame = laser.topic.name, laser.first.frame
        if (other := topic_of.setdefault(frame, name)) != name:
            raise InputError(
                f"the scans of {other} and {name} have one frame, '{frame}', so tf cannot give the pose of each laser; "
                "give it with --sensors laser-pose=X,Y,THETA for each"
            )
    return [_mounting_in(tree, base_frame, laser) for laser in lasers]


def _mounting_in(tree: TransformTree, base_frame: str, laser: RecordedLaser) -> Mounting:
    try:
        mounted = mounting(tree.fixed(base_frame, laser.first.frame))
    except NoTransformError as error:
        raise NoTransformError(f"{error}, so the pose of the laser of {laser.name} is unknown") from error
    away_m = hypot(*mounted.T_base_laser[:2])
    if away_m > FARTHEST_SENSOR_M:
        raise InputError(
            f"tf puts the laser of {laser.name} {away_m:.0f} m from '{base_frame}', as if in millimetres or "
            "centimetres; correct it in tf, or give its pose with --sensors laser-pose=X,Y,THETA (metres, radians)"
        )
    if laser.is_level:
        return Mounting(mounted.T_base_laser, upside_down=False, tilt_rad=0.0)
    if mounted.tilt_rad > _STEEPEST_RAD:
        raise InputError(
            f"the laser of {laser.name} is tilted by {degrees(mounted.tilt_rad):.0f} degrees and does not look along "
            "the floor; choose a level one by --sensors scan-topic, or give its pose with --sensors laser-pose"
        )
    return mounted


def turned_beams(beams: Beams, upside_down: bool) -> Beams:
    """The beams as they are seen from above."""
    return beams._replace(angle_min_rad=-(beams.angle_min_rad + beams.span_rad)) if upside_down else beams
