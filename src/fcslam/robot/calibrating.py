"""Calibration of a bag before it is mapped: its first minutes are tracked without odometry, and compared with it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Final, TypeGuard

import numpy as np

from fcslam.geometry import se2
from fcslam.geometry.beams import is_same_laser
from fcslam.lidar.calibration import Estimate, MotionCalibration, OdometryTrack, ScanMotions, calibrate
from fcslam.lidar.facing import AS_STATED, MOST_COMPARED, Contradiction, contradicted_facing
from fcslam.lidar.frontend import LidarConfig, LidarFrontend
from fcslam.lidar.leaning import floor_line
from fcslam.lidar.odometry import PREDICTED
from fcslam.lidar.own_body import SAME_M, body_radius_m, body_sectors
from fcslam.lidar3d.ground import seen_by
from fcslam.records import Beams, CloudScan, FloatArray, LaserModel, LaserScan, Odometry, SensorRecord, Sweep
from fcslam.robot.mapped_scans import MappedScans
from fcslam.robot.predicted_motion import PredictedMotion
from fcslam.robot.wheel_odometry import is_jump
from fcslam.sources.bags.options import BagCorrection
from fcslam.sources.clouds_in_space import BAND_LASER
from fcslam.sources.contradictions import RepeatedScans
from fcslam.sources.formats import bag_of, is_whole
from fcslam.sources.motion import OdometryUpdates
from fcslam.sources.pose import pose_of
from fcslam.sources.returns import FloorLine
from fcslam.sources.source import Derived, Doubt, Source, Survey

if TYPE_CHECKING:
    from fcslam.sources.bags.rosbag import RosBag

MOST_JUMPS: Final = 10
"""Odometry that jumps more often is wrong."""
MOST_SCANS: Final = 1200
"""Scans that are tracked at most."""
ENOUGH_TURN_RAD: Final = 40.0
"""Turns, all together, after which no more scans are tracked."""
LARGEST_WHEEL_SCALE: Final = 1.5
"""Distances that differ by a larger factor may be due to the unit of the ranges."""
LARGEST_SPAN_DEG: Final = 400.0
"""No beams span more than a turn, with the error of an estimate."""
LARGEST_SCALE: Final = 2.0
"""Odometry that turns more or less than the scans by a larger factor measures something else."""
LONGEST_PERIOD_S: Final = 0.12
"""Odometry that comes more seldom says nothing about delays: it is interpolated."""
LEAST_DELAY_S: Final = 0.02
LEAST_YAW_RAD: Final = 0.005
LEAST_OFFSET_M: Final = 0.02
LARGEST_OFFSET_M: Final = 1.0
"""A laser is not farther from where tf says: one circle fixes neither mounting nor times; then nothing is corrected."""
LEAST_SCALE: Final = 0.01
GROSS_SCALE: Final = 0.25
"""Scales that differ by more are no matter of precision."""
LEAST_SHARE: Final = 0.25
"""Smaller differences from what the bag says are not corrected: matching holds back short turns by up to 20 %."""
AT_ONCE_SHARE: Final = 0.2
"""Beams that take a smaller share of the time between scans are measured at once, unless they are only said to."""
WHOLE_SHARE: Final = 0.05
"""A scanner that spins without a pause measures all the time between scans."""
FLOOR_HALF_DEG: Final = 75
"""Half of the sector in which a leaning laser sees the floor at most."""
STAMP_TOLERANCE_S: Final = 0.005
"""Tolerance by which a delay is that of a stamp in the middle or at the end of a scan, and not of another clock."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """Estimates from the motion in a bag, and the corrections that they allow."""

    calibration: MotionCalibration
    correction: BagCorrection
    lines: tuple[str, ...]
    """A sentence for each correction, with its standard deviation."""


def calibrate_bag(bag: "RosBag", config: LidarConfig) -> Calibrated:
    """Estimate the timing and the mounting of the first laser of a bag with one laser."""
    contradictions = _contradictions(bag)
    floors = tuple(floor for _, floor in contradictions)
    if not any(floors):
        return _calibrate_level(bag, config, [facing for facing, _ in contradictions])
    level = bag.corrected(BagCorrection(floors=floors), ())
    calibrated = _calibrate_level(level, config, [facing for facing, _ in _contradictions(level)])
    lines = (*(f"{floor}; its returns are left out" for floor in filter(None, floors)), *calibrated.lines)
    return replace(calibrated, correction=replace(calibrated.correction, floors=floors), lines=lines)


def _calibrate_level(bag: "RosBag", config: LidarConfig, facings: list[Contradiction | None]) -> Calibrated:
    if len(facings) > 1:
        named = zip(bag.plan.lasers, facings, strict=True)
        lines = tuple(f"{laser.name}: {found}; not corrected" for laser, found in named if found)
        return Calibrated(MotionCalibration(), BagCorrection(), lines)
    (found,) = facings
    if found is None:
        return _calibrate_finely(bag, config)
    if found.facing == AS_STATED:
        fine = _calibrate_finely(bag, config)
        scales = fine.calibration.turn_scale, fine.calibration.distance_scale
        is_explained = any(map(_is_wrong, scales)) or fine.correction.odometry_delay_s != 0.0  # another clock
        lines_before = () if is_explained else (f"{found}; not corrected",)
        return replace(fine, lines=(*lines_before, *fine.lines))
    turned_deg, upside_down = found.facing
    T_base_laser = np.array(bag.survey().lasers[0].T_base_laser)
    turned = se2.compose(T_base_laser, (0.0, 0.0, math.radians(turned_deg)))
    x, y, theta = se2.compose(turned, se2.inverse(T_base_laser)).tolist()
    coarse = BagCorrection(mounting=(x, y, theta), upside_down=upside_down)
    fine = _calibrate_finely(bag.corrected(coarse, ()), config)
    x, y, theta = se2.compose(fine.correction.mounting, coarse.mounting).tolist()
    done = "--sensors laser-pose is kept" if bag.options.laser_poses else "corrected"
    correction = replace(fine.correction, mounting=(x, y, theta), upside_down=upside_down)
    return Calibrated(fine.calibration, correction, (f"{found}; {done}", *fine.lines))


def contradictions_of(source: Source) -> tuple[str, ...]:
    """Lines about the lasers of a recording of any format that contradict its odometry."""
    say = _without_tf if bag_of(source) is None else str
    lines = []
    for laser, (facing, floor) in zip(source.survey().lasers, _contradictions(source), strict=True):
        if facing is not None:
            lines.append(say(facing))
        if floor is not None:
            middle_deg = round(math.degrees(se2.wrap_angle(floor.heading_rad + laser.T_base_laser[2])))
            ignored = [middle_deg - FLOOR_HALF_DEG, middle_deg + FLOOR_HALF_DEG]
            lines.append(
                f"{floor}, or leave its beams out by the configuration: robot: {{lidar: {{ignore: [{ignored}]}}}}"
            )
    return tuple(f"{source.name}: {line}" for line in lines)


def _turned(source: Source) -> tuple[str, ...]:
    """A line about a 3D LiDAR whose heading contradicts the wheels, by what a 2D laser would see."""
    scans = (
        LaserScan(
            each.stamp, seen_by(BAND_LASER, *[each.points_m.astype(np.float64)] * 2), BAND_LASER, each.T_odom_base
        )
        for each in (source.records() if source.survey().path_length_m else ())
        if isinstance(each, CloudScan)
    )
    found = contradicted_facing(scans)
    return (f"{source.name}: {found}",) if found is not None and found.facing.turned_deg else ()


def _without_tf(found: Contradiction) -> str:
    return found.line(
        "write the recording as a bag by `fcslam record` and map that, which corrects the mounting of one laser; or "
        "correct the signs of the odometry"
    )


def bodies_of(source: Source) -> tuple[str, ...]:
    """Lines about the sectors in which lasers see the robot itself."""
    sectors = [
        [round(first_deg), round(last_deg)]
        for laser in source.survey().lasers
        for first_deg, last_deg in body_sectors(_scans_of(laser, source))
    ]
    if not sectors:
        return ()
    return (
        f"{source.name}: some beams see the robot itself, as they never change; to leave them out, add to the "
        f"configuration: robot: {{lidar: {{ignore: {sectors}}}}}",
    )


def ramps_of(source: Source) -> tuple[str, ...]:
    """A line about ramps over which a robot drives, by the clouds that are its scans."""
    if (bag := bag_of(source)) is None:
        return ()
    stamps = [stamp for laser in bag.plan.lasers if laser.is_level for stamp in bag.plan.scans.bends(laser.topic)]
    if not stamps:
        return ()
    begin_s, end_s = (stamp - bag.plan.lasers[0].first.stamp for stamp in (min(stamps), max(stamps)))
    between = f"between {begin_s:.0f} s and {end_s:.0f} s"
    wrong = "and a 2D map is wrong there; map with --3d"
    return (Doubt(f"{bag.path}: the robot drives over a ramp {between}, {wrong}"),)


def _scans_of(laser: LaserModel, source: Source) -> Iterator[LaserScan]:
    return (each for each in source.records() if isinstance(each, LaserScan) and is_same_laser(each.laser, laser))


def _contradictions(source: Source) -> list[tuple[Contradiction | None, FloorLine | None]]:
    found, survey = [], source.survey()
    most = min(MOST_COMPARED, survey.scan_count - 1)  # a log that is read to its end leaves the memory
    for laser in survey.lasers:
        first = list(islice(_scans_of(laser, source), most))
        found.append((contradicted_facing(first), floor_line(first)))
    return found


def _calibrate_finely(bag: "RosBag", config: LidarConfig) -> Calibrated:
    survey = bag.survey()
    assumed_s = survey.duration_s / max(1, survey.scan_count - 1)
    if len(survey.lasers) > 1 or not 0.0 < assumed_s < 1.0:
        return Calibrated(MotionCalibration(), BagCorrection(), ())
    motions, odometry = _tracked(bag.records(), config, assumed_s)
    if len(motions.stamps) < 2:
        return Calibrated(MotionCalibration(), BagCorrection(), ())
    if odometry is not None:
        calibration = calibrate(motions, odometry)
    else:
        known = np.isfinite(motions.T_local_base[:, 0])
        by_scans = OdometryTrack(motions.stamps[known], _unwrapped(motions.T_local_base[known]))
        calibration = MotionCalibration(sweep_share=calibrate(motions, by_scans).sweep_share)
    scale = calibration.turn_scale
    if scale is not None and not 1.0 / LARGEST_SCALE < scale.value < LARGEST_SCALE:
        return Calibrated(calibration, BagCorrection(), tuple(_scale_lines(calibration, survey.lasers[0].beams)))
    if odometry is not None and odometry.period_s > LONGEST_PERIOD_S:
        calibration = replace(calibration, delay=None)
    if _is_wrong(distance := calibration.distance_scale) and not _is_of_wheels(distance):
        calibration = replace(calibration, mounting=None)  # in which unit, is not known
    assumed = float(np.median(motions.first_s)), float(np.median(motions.last_s))
    done = "--sensors laser-pose is kept" if bag.options.laser_poses else "used"
    found = _corrected(calibration, assumed, _stated_share(bag.plan.stated_sweep, assumed_s), done)
    sweep = found.correction.sweep
    if sweep is not None and bag.is_upside_down:  # the beams of the message are in the opposite order
        found = replace(found, correction=replace(found.correction, sweep=sweep[::-1]))
    return replace(found, lines=(*found.lines, *_scale_lines(calibration, survey.lasers[0].beams)))


def _is_wrong(scale: Estimate | None) -> TypeGuard[Estimate]:
    return scale is not None and (scale.differs(1.0, 5.0 * LEAST_SCALE) or scale.differs(1.0, GROSS_SCALE, sigmas=3.0))


def _is_of_wheels(scale: Estimate) -> bool:
    """Whether odometry may be wrong by so much; else the unit of the ranges may be."""
    return 1.0 / LARGEST_WHEEL_SCALE < scale.value < LARGEST_WHEEL_SCALE


def _scale_lines(calibration: MotionCalibration, beams: Beams) -> Iterator[str]:
    distance, turn = calibration.distance_scale, calibration.turn_scale
    if _is_wrong(turn) and not 1.0 / LARGEST_SCALE < turn.value < LARGEST_SCALE:
        yield _scale_line(
            "turn",
            turn,
            "correct the mounting of the laser in tf, which may be upside down, or the heading of the odometry, or "
            "choose topics of one robot by --sensors scan-topic and odom-topic",
        )
        return
    if _is_wrong(distance):
        unit = "" if _is_of_wheels(distance) else ", or the unit of the ranges, which may be feet"
        line = _scale_line("distance", distance, f"correct the radius of the wheels in its driver{unit}")
        yield Doubt(line) if unit else line
    if _is_wrong(turn):
        remedy = "correct the distance of the wheels in its driver"
        stated_deg = math.degrees(beams.span_rad + beams.angle_increment_rad)
        if (span_deg := stated_deg / turn.value) <= LARGEST_SPAN_DEG:
            remedy += f", or the angles of the beams, which then span {span_deg:.0f} deg and not {stated_deg:.0f}"
        yield _scale_line("turn", turn, remedy)


def _scale_line(name: str, scale: Estimate, remedy: str) -> str:
    state = "mapping follows the scans" if _is_of_wheels(scale) else "not corrected"
    return f"the robot's {name} is {scale.value:.3f} of what odometry says (+- {scale.sigma:.3f}); {state}: {remedy}"


class Noted(Derived):
    """A recording with further notes in its survey."""

    def __init__(self, source: Source, notes: tuple[str, ...]) -> None:
        super().__init__(source)
        self._notes = notes

    def survey(self) -> Survey:
        """As in Source."""
        survey = self._source.survey()
        return replace(survey, notes=(*survey.notes, *self._notes))


def calibrated(source: Source, config: LidarConfig) -> Source:
    """A recording with what its motion says against it; only a bag is corrected."""
    bag = bag_of(source)
    if bag is None:
        said = _turned(source) if is_whole(source) else contradictions_of(source)
        return Noted(source, tuple(f"{line}; not corrected" for line in said)) if said else source
    of_clouds = [model for model, its in zip(bag.survey().lasers, bag.plan.lasers, strict=True) if its.is_level]
    radius_m = max((body_radius_m(_scans_of(laser, bag), laser) for laser in of_clouds), default=0.0)
    if radius_m > bag.options.cloud_band.body_radius_m:
        bag = bag.without_body(radius_m + SAME_M)
    found = calibrate_bag(bag, config)
    lines = (*ramps_of(bag), *(type(line)(f"{bag.path}: {line}") for line in found.lines))  # a doubt stays one
    return bag.corrected(found.correction, lines) if lines else bag


def _tracked(
    records: Iterator[SensorRecord], config: LidarConfig, assumed_s: float
) -> tuple[ScanMotions, OdometryTrack | None]:
    frontend = LidarFrontend("calibration", config, PREDICTED)
    motion, mapped, repeated = PredictedMotion(), MappedScans(config.ignore, config.footprint), RepeatedScans()
    unknown = np.full(3, np.nan)
    rows: list[tuple[float, ...]] = []
    odometry: list[Odometry] = []
    turn_rad = 0.0
    for record in records:
        if isinstance(record, Odometry):
            odometry.append(record)
        if not isinstance(record, LaserScan) or not repeated.admits(record):
            continue
        if len(rows) == MOST_SCANS or turn_rad > ENOUGH_TURN_RAD:
            break
        beams = Sweep(*_times(record.sweep, assumed_s))
        # without the gyro, whose turns in the assumed sweep would hide what the points say about its times
        scan = motion.place(mapped.of(replace(record, T_odom_base=unknown, sweep=beams, gyro=None)))
        tracking = frontend.localize(scan)
        frontend.process(scan, tracking)
        tracked, is_matched = tracking.tracked, bool(tracking.tracked.information.any())
        sweep = tracked.sweep
        assert sweep is not None
        motion.observe(scan.stamp, tracked.T_local_base, tracked)
        turn = float(sweep.displacement(sweep.last_s)[2] - sweep.displacement(sweep.first_s)[2])
        found = tracked.T_local_base if is_matched else unknown
        rows.append((scan.stamp, *found, turn if is_matched else np.nan, sweep.first_s, sweep.last_s))
        turn_rad += abs(turn)
    columns = np.array(rows).reshape(-1, 7).T
    motions = ScanMotions(columns[0], columns[1:4].T, columns[4], columns[5], columns[6])
    return motions, _track_of(odometry)


def _times(stated: Sweep | None, assumed_s: float) -> tuple[float, float]:
    """Times of the first and the last beam with which a scan is tracked.

    Some drivers state times that are far too short, which say as little as none.
    """
    is_said = stated is not None and abs(stated.last_s - stated.first_s) > AT_ONCE_SHARE * assumed_s
    return (stated.first_s, stated.last_s) if stated is not None and is_said else (0.0, assumed_s)


def _stated_share(stated: Sweep | None, assumed_s: float) -> float:
    if stated is None:
        return 0.0
    first_s, last_s = _times(stated, assumed_s)
    return (stated.last_s - stated.first_s) / (last_s - first_s)


def _track_of(odometry: list[Odometry]) -> OdometryTrack | None:
    """The updates with growing stamps; None without any."""
    updates = OdometryUpdates()
    fresh = [reading for reading in odometry if updates.is_fresh(reading.stamp, pose_of(reading.T_odom_base))]
    if not fresh:
        return None
    stamps = np.array([reading.stamp for reading in fresh])
    grows = np.concatenate(([True], stamps[1:] > np.maximum.accumulate(stamps)[:-1]))
    poses = np.array([reading.T_odom_base for reading in fresh])
    period_s = max(updates.period_s, float(np.median(np.diff(stamps[grows]))) if grows.sum() > 1 else 0.0)
    stamps, poses = stamps[grows], poses[grows]
    steps = se2.between(poses[:-1], poses[1:]).tolist()
    jumps = [at for at, step in enumerate(steps, 1) if is_jump(step, stamps[at] - stamps[at - 1])]
    for at in jumps if len(jumps) <= MOST_JUMPS else ():  # odometry that begins again goes on from where it was
        poses[at:] = se2.compose(poses[at - 1], se2.between(poses[at], poses[at:]))
    return OdometryTrack(stamps, _unwrapped(poses), period_s)


def _unwrapped(poses: FloatArray) -> FloatArray:
    known = poses.copy()
    known[:, 2] = np.unwrap(known[:, 2])
    return known


def _corrected(calibration: MotionCalibration, assumed: tuple[float, float], nominal: float, done: str) -> Calibrated:
    """The significant estimates as a correction and in words.

    Args:
        calibration: the estimates.
        assumed: times of the first and the last beam after the stamp with which the scans were tracked, seconds.
        nominal: duration of a scan as the bag states it, per assumed duration; 0: all beams at once.
        done: what becomes of the estimated mounting.
    """
    if calibration.mounting is not None:
        x, y, _ = calibration.mounting
        if math.hypot(x.value, y.value) > LARGEST_OFFSET_M:
            return Calibrated(calibration, BagCorrection(), ())
    share = _share(calibration)
    is_late = calibration.delay is not None and calibration.delay.differs(0.0, LEAST_DELAY_S)
    is_other = share is not None and share.differs(nominal, LEAST_SHARE)
    if not is_late and not is_other:
        return _mounted(calibration, BagCorrection(), [], done)
    delay_s = calibration.delay.value if calibration.delay is not None and is_late else 0.0
    taken = nominal
    if share is not None and is_other:
        is_whole = abs(abs(share.value) - 1.0) < max(WHOLE_SHARE, share.sigma)
        taken = math.copysign(1.0, share.value) if is_whole else share.value
    first_s = assumed[0] * nominal + delay_s
    last_s = first_s + (0.0 if abs(taken) < AT_ONCE_SHARE else taken) * (assumed[1] - assumed[0])
    if calibration.delay is None:  # without odometry, the stamp is taken to be that of the beam measured first
        earliest_s = min(first_s, last_s, 0.0)
        first_s, last_s = first_s - earliest_s, last_s - earliest_s
    correction, lines = BagCorrection(), []
    where = _stamped(first_s, last_s)
    if where is None:  # no beam is measured at the stamp: another clock
        ahead_s = min(first_s, last_s)
        correction = replace(correction, odometry_delay_s=ahead_s)
        lines.append(f"the clock of the odometry is {1e3 * ahead_s:.0f} ms ahead of that of the scans; corrected")
        first_s, last_s, where = first_s - ahead_s, last_s - ahead_s, "first"
    if is_other or where != "first":
        correction = replace(correction, sweep=(first_s, last_s))
        duration = f"takes {1e3 * abs(last_s - first_s):.0f} ms{' clockwise' * (last_s < first_s)}"
        lines.append(
            "all beams of a scan are measured at once; used"
            if first_s == last_s
            else f"a scan {duration}, and its stamp is that of the {where} beam; used"
        )
    return _mounted(calibration, correction, lines, done)


def _share(calibration: MotionCalibration) -> Estimate | None:
    if calibration.sweep_share is None:
        return None
    scale = 1.0 if calibration.turn_scale is None else abs(calibration.turn_scale.value)
    return Estimate(calibration.sweep_share.value / scale, calibration.sweep_share.sigma / scale)


def _stamped(first_s: float, last_s: float) -> str | None:
    """Which beam is measured at the stamp, in the order of time; None if it is another one."""
    earliest_s, latest_s = min(first_s, last_s), max(first_s, last_s)
    times = (("first", earliest_s), ("last", latest_s), ("middle", 0.5 * (earliest_s + latest_s)))
    return next((where for where, time_s in times if abs(time_s) <= STAMP_TOLERANCE_S), None)


def _mounted(calibration: MotionCalibration, correction: BagCorrection, lines: list[str], done: str) -> Calibrated:
    if calibration.mounting is None:
        return Calibrated(calibration, correction, tuple(lines))
    x, y, yaw = calibration.mounting
    moved = [0.0, 0.0, 0.0]
    if yaw.differs(0.0, LEAST_YAW_RAD):
        side = "left" if yaw.value > 0.0 else "right"
        lines.append(
            f"the laser is mounted {math.degrees(abs(yaw.value)):.1f} deg (+- {math.degrees(yaw.sigma):.1f}) to the "
            f"{side} of what is stated; {done}"
        )
        moved[2] = yaw.value
    if x.differs(0.0, LEAST_OFFSET_M) or y.differs(0.0, LEAST_OFFSET_M):
        lines.append(
            f"the laser is mounted {x.value:+.2f} m (+- {x.sigma:.2f}) along x and {y.value:+.2f} m (+- {y.sigma:.2f}) "
            f"along y from where it is stated; {done}"
        )
        moved[0], moved[1] = x.value, y.value
    return Calibrated(calibration, replace(correction, mounting=(moved[0], moved[1], moved[2])), tuple(lines))
