"""Recordings as drivers and faulty robots make them: is the path right, or does a line say why not?

    python benchmarks/recordings.py
    python benchmarks/recordings.py --only intensities

A robot drives a winding path of 3 to 9 s through a furnished room, at up to 1.6 rad/s. Each recording is a ROS 2 bag
after the documentation of a driver, as in `tests/sources/test_drivers.py`, or has a fault that users report. It is read
as `fcslam map` does. The error is that of the positions at all scans after a rigid alignment.

- right: the error is at most 0.02 m.
- said: the error is larger, and a line says what is wrong.
- refused: no map is made, and a line says why.
- wrong: the error is larger, and nothing is said.

Clouds of 16 rings come at 10 Hz from a scanner that turns while the robot does.

A gyro measures at 100 Hz, with a bias of 0.02 rad/s and noise of 0.005 rad/s. The scanner then turns at 5 Hz, and the
robot at up to 2 rad/s.
"""

# ruff: noqa: ARG005  all changes have the same arguments

import math
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import common
import numpy as np

from fcslam.geometry import se2
from fcslam.sources.bags.codec import IMU, MessageCodec

sys.path.insert(0, str(common.REPOSITORY))
from tests.sources import clouds as made
from tests.sources import test_drivers as drivers
from tests.sources.bag_messages import Said, odom, quaternion, save, tf
from tests.sources.test_drivers import START, Scanner, pose_at

RIGHT_M = 0.02
SAID = "contradict", "not corrected", "have no times", "was lost", "while the odometry stands still", "which then span"
"""Parts of the lines that say what is wrong."""
COLUMNS = {"kind": "", "recording": "", "error, m": ".4f", "outcome": "", "said": ""}
COUNTS = {"kind": "", "recordings": "", "right": "", "said": "", "refused": "", "wrong": ""}
GYRO_COLUMNS = {"wheels": "", "gyro": "", "error, m": ".4f"}
CLOUD_COLUMNS = {"drive": "", "scans": "", "ATE (RMSE), m": ".4f"}
MOUNTING = (0.1, 0.0, 0.4)
YAW = 0.4
"""Of the 3D LiDAR."""


class Cloud(NamedTuple):
    """How a 3D LiDAR measures, and what its driver says."""

    layout: tuple
    first_rad: float = -math.pi
    clockwise: bool = True
    parts: int = 1
    """Messages of a turn."""
    holes: float = 0.0
    """Range of a beam without a return."""


def times(kind, unit=1.0, since=0.0, name="timestamp"):
    """A layout whose field has the times of the points in ``unit``."""
    return 24, [*made.xyz(), (name, kind, 16, lambda measured: np.round((since + measured.times) * unit, 9))]


VELODYNE = times("f4", name="time")
CLOUD_DRIVERS = {
    "velodyne": Cloud(lambda _: VELODYNE),
    "ouster, ns and zeros": Cloud(lambda _: times("u4", 1e9, name="t"), first_rad=0.0),
    "hesai, absolute": Cloud(lambda begin: times("f8", 1.0, begin)),
    "robosense, NaN": Cloud(lambda begin: times("f8", 1.0, begin), holes=math.nan),
    "livox, absolute ns": Cloud(lambda begin: times("f8", 1e9, begin), clockwise=False),
    "sick multiScan, sectors": Cloud(lambda _: times("u4", 1e9, name="t"), parts=10),
    "velodyne, packets": Cloud(lambda _: VELODYNE, parts=60),
}


def clouds_of(its: Cloud) -> Iterator:
    """The messages of a 3D LiDAR for 3 s."""
    R = made.rotation(yaw=YAW)
    yield tf(START, "base_link", "lidar", MOUNTING, quaternion(YAW), topic="/tf_static")
    for number in range(30):
        begin = 0.1 * number
        turn = made.spinning(
            lambda t, begin=begin: pose_at(begin + t), MOUNTING, R, 4, 360, its.clockwise, its.first_rad
        )
        turn.points[::50] = its.holes
        for rows in np.array_split(np.arange(len(turn.points)), its.parts):
            first_s = turn.times[rows[0]]
            part, at = made.Measured(turn.points[rows], turn.times[rows] - first_s), START + begin + first_s
            yield made.said("/points", at, made.cloud(at, part, its.layout(START + begin)))


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--only", default="", help="part of the names of the recordings")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = [row(*each) for each in recordings() if chosen.only in each[1]]
    kinds = dict.fromkeys(kind for kind, *_ in rows)
    counts = {kind: [outcome for its, _, _, outcome, _ in rows if its == kind] for kind in kinds}
    report.table(
        "Outcomes", COUNTS, [(kind, len(all_), *map(all_.count, list(COUNTS)[2:])) for kind, all_ in counts.items()]
    )
    report.table("Recordings", COLUMNS, rows)
    if not chosen.only:
        report.table(
            "Clouds of 16 rings", CLOUD_COLUMNS, [rings(*each) for each in ((False, 0.0), (True, 0.0), (False, 6.0))]
        )
    if not chosen.only:
        report.table("Gyro", GYRO_COLUMNS, list(with_gyro()))
    report.write()


def with_gyro() -> Iterator[tuple]:
    """Drives of 18 s without wheels, and with wheels that slip by 20 % for a third of it."""
    its = Scanner(hz=5.0, turns_s=0.2 * 359 / 360, pace=1.25)
    mounting, *scans = [each for each in drivers.recording(its) if each.topic != "/odom"]
    stamps = np.arange(0.0, drivers.SCANS / its.hz + 0.5, 0.02)
    true = pose_at(its.pace * stamps)
    steps = se2.between(true[:-1], true[1:])
    steps[(stamps[1:] > 6.0) & (stamps[1:] < 12.0)] *= 1.2
    wheels = [odom(START, true[0].tolist(), bag_time=START)]
    pose = true[0]
    for t, step in zip(stamps[1:].tolist(), steps, strict=True):
        pose = se2.compose(pose, step)
        wheels.append(odom(START + t, pose.tolist(), bag_time=START + t))
    for name, odometry in (("none", []), ("slip", wheels)):
        for imu in ([], list(turns(its.pace))):
            with TemporaryDirectory() as folder:
                path = save(Path(folder) / "run.mcap", [mounting, *odometry, *scans, *imu])
                yield name, "yes" if imu else "no", drivers.outcome(path, pace=its.pace)[1]


def turns(pace: float) -> Iterator:
    rng, codec = np.random.default_rng(7), MessageCodec(ros1=False)
    for t in np.arange(0.0, 18.5, 0.01).tolist():
        rate = float(np.diff(pose_at(pace * (t + np.array((-1e-3, 1e-3))))[:, 2])[0]) / 2e-3
        measured = codec.vector("Vector3", z=rate + 0.02 + float(rng.normal(0.0, 0.005)))
        header = codec.header(round((START + t) * 1e9), "base_link")
        payload = codec.encode(codec.make(IMU, header=header, angular_velocity=measured), IMU)
        yield Said("/imu", IMU, START + t, {"payload": payload})


def row(kind: str, name: str, messages: Iterable) -> tuple:
    with TemporaryDirectory() as folder:
        said, error_m = drivers.outcome(save(Path(folder) / "run.mcap", messages))
        said = said.replace(folder + "/run.mcap: ", "")
    if error_m is None:
        return kind, name, math.nan, "refused", said
    is_said = any(word in said for word in SAID)
    return kind, name, error_m, "right" if error_m <= RIGHT_M else "said" if is_said else "wrong", said or "-"


def recordings() -> Iterator[tuple[str, str, Iterable]]:
    """Kind, name and messages of each."""
    yield from (("driver", name, drivers.recording(its)) for name, its in drivers.SCANNERS.items())
    for name, its in CLOUD_DRIVERS.items():
        yield "driver of a 3D LiDAR", name, [*drivers.readings(3.0), *clouds_of(its)]
    yield from (("robot", name, make()) for name, (make, _) in drivers.ROBOTS.items())
    yield from (("ranges", name, with_ranges(change)) for name, change in RANGES.items())
    yield from (("odometry", name, with_odometry(change)) for name, change in ODOMETRY.items())
    for turned_deg, roll_rad in ((90, 0.0), (180, 0.0), (-45, 0.0), (0, math.pi), (90, math.pi)):
        name = f"turned by {turned_deg} deg" + ", upside down" * bool(roll_rad)
        yield "mounting", name, mounted(quaternion(math.radians(turned_deg), roll_rad))
        yield "mounting of a 3D LiDAR", name, with_clouds(quaternion(YAW + math.radians(turned_deg), roll_rad))
    for leans in ({"pitch_deg": 20.0}, {"roll_deg": -35.0}):
        yield "mounting of a 3D LiDAR", "leaning against tf, " + str(leans), with_clouds(rings=16, **leans)
    yield from (("cloud", name, with_clouds(**change)) for name, change in CLOUDS.items())


def noise(number: int, scale: float, count: int):
    return np.random.default_rng(number).normal(0.0, scale, count)


RANGES = {
    "intensities, whole": lambda k, r: np.round(60.0 / np.maximum(r, 0.3) + noise(k, 1.0, len(r))),
    "intensities of 8 bits": lambda k, r: np.clip(np.round(200.0 - 10.0 * r + noise(k, 5.0, len(r))), 0, 255),
    "intensities of 12 bits": lambda k, r: np.round(4000.0 / np.maximum(r, 0.5) + noise(k, 20.0, len(r))),
    "intensities, fractions": lambda k, r: np.clip(1.0 - r / 12.0 + noise(k, 0.03, len(r)), 0.0, 1.0),
    "intensities of surfaces": lambda k, r: 2.0 + 1.5 * np.sin(7.0 * r) + noise(k, 0.1, len(r)),
    "intensities by the square of the distance": lambda k, r: 12.0 / np.maximum(r, 0.5) ** 2,
    "quality of the returns": lambda k, r: np.clip(np.round(15.0 + noise(k, 3.0, len(r))), 0, 63),
    "noise": lambda k, r: np.random.default_rng(k).uniform(0.2, 8.0, len(r)),
    "squares of ranges": lambda k, r: r**2,
    "logarithms of ranges": lambda k, r: 2.0 * np.log(r + 0.5),
    "roots of ranges": lambda k, r: 2.0 * np.sqrt(r),
    "0.3 m too long": lambda k, r: r + 0.3,
    "0.3 m too short": lambda k, r: np.maximum(r - 0.3, 0.0),
    "two way distances": lambda k, r: 2.0 * r,
    "whole metres": lambda k, r: np.floor(r),
    "beams in another order": lambda k, r: r[np.random.default_rng(0).permutation(len(r))],
    "beams in the opposite order": lambda k, r: r[::-1],
    "beams that begin elsewhere": lambda k, r: np.roll(r, 60),
    "every beam twice": lambda k, r: np.repeat(r[::2], 2),
    "one scan for ever": lambda k, r: 2.0 + np.sin(np.arange(len(r)) / 20.0),
    "centimetres": lambda k, r: np.round(100.0 * r),
    "kilometres": lambda k, r: r / 1000.0,
    "half of the beams 0": lambda k, r: np.where(np.arange(len(r)) % 2, r, 0.0),
    "a placeholder in a third of the beams": lambda k, r: np.where(noise(k, 1.0, len(r)) > 0.43, 4.0, r),
    "a cable before the laser": lambda k, r: np.where(np.abs(np.arange(len(r)) - 200) < 12, 0.18, r),
}


def with_ranges(change) -> Iterator:
    number = 0
    for each in drivers.recording(Scanner()):
        if each.topic == "/scan":
            number += 1
            ranges = change(number, np.array(each.fields["ranges"], float))
            yield each._replace(fields={**each.fields, "ranges": ranges})
        else:
            yield each


ODOMETRY = {
    "heading in degrees": lambda t, x, y, a: (x, y, math.degrees(a)),
    "heading of the other sign": lambda t, x, y, a: (x, y, -a),
    "heading never set": lambda t, x, y, a: (x, y, 0.0),
    "position never set": lambda t, x, y, a: (0.0, 0.0, a),
    "never set": lambda t, x, y, a: (0.0, 0.0, 0.0),
    "turns of wheels of another distance": lambda t, x, y, a: (x, y, 1.3 * a),
    "y of the other sign": lambda t, x, y, a: (x, -y, a),
    "x and y swapped": lambda t, x, y, a: (y, x, a),
    "backwards": lambda t, x, y, a: (-x, -y, a),
    "inverse pose": lambda t, x, y, a: tuple(se2.inverse(np.array((x, y, a)))),
    "half the distance": lambda t, x, y, a: (0.5 * x, 0.5 * y, a),
    "centimetres": lambda t, x, y, a: (100.0 * x, 100.0 * y, a),
    "millimetres": lambda t, x, y, a: (1000.0 * x, 1000.0 * y, a),
    "of another robot": lambda t, x, y, a: (0.3 * t, 0.0, 0.4 * math.sin(t)),
    "two publishers that begin elsewhere": lambda t, x, y, a: (x + 5.0 * (round(t / 0.08) % 2), y, a),
    "reset after 4 s": lambda t, x, y, a: tuple(se2.between(pose_at(4.0 * (t > 4.0)), np.array((x, y, a)))),
    "in steps of 0.5 s": lambda t, x, y, a: tuple(pose_at(0.5 * math.floor(2.0 * t))),
    "NaN at times": lambda t, x, y, a: (math.nan if round(t / 0.08) % 7 == 0 else x, y, a),
}


def with_odometry(change) -> Iterator:
    for each in drivers.recording(Scanner()):
        if each.topic == "/odom":
            t = each.fields["stamp"] - START
            yield odom(START + t, change(t, *pose_at(t).tolist()), bag_time=each.bag_time)
        else:
            yield each


def mounted(rotation) -> Iterator:
    """A laser that tf has so, though it is level and looks ahead."""
    yield tf(START, "base_link", "laser", (0.12, 0.0, 0.2), rotation, topic="/tf_static")
    yield from (each for each in drivers.recording(Scanner()) if each.topic != "/tf_static")


def with_clouds(
    rotation=None,
    layout=VELODYNE,
    count=60,
    change=lambda message: message,
    holes=0.0,
    height=1,
    pitch_deg=0.0,
    roll_deg=0.0,
    rings=4,
    **fields,
) -> Iterator:
    yield tf(START, "base_link", "lidar", MOUNTING, rotation or quaternion(YAW), topic="/tf_static")
    yield from drivers.readings(0.1 * count)
    R = made.rotation(math.radians(roll_deg), math.radians(pitch_deg), YAW)
    for number in range(count):
        begin = 0.1 * number
        turn = made.spinning(lambda t, begin=begin: pose_at(begin + t), MOUNTING, R, rings, 360, True, math.pi)
        turn.points[::50] *= holes
        message = made.cloud(START + begin, turn, layout, height=height, **fields)
        yield made.said("/points", START + begin, change(message))


def swapped(message):
    size = message.point_step
    rows = np.array(message.data).reshape(-1, size)
    message.data = rows.reshape(len(rows), size // 4, 4)[:, :, ::-1].reshape(-1)
    message.is_bigendian = True
    return message


def padded(message):
    rows = np.array(message.data).reshape(message.height, -1)
    message.data = np.pad(rows, ((0, 0), (0, 40))).reshape(-1)
    message.row_step = rows.shape[1] + 40
    return message


TIME = "time", "f4", 60, lambda m: m.times


def in_unit(scale: float, kind: str = "f4") -> tuple:
    """A layout whose points are in another unit."""
    fields = [(name, kind, 4 * axis, lambda m, axis=axis: scale * m.points[:, axis]) for axis, name in enumerate("xyz")]
    return 64, [*fields, TIME]


def moved(places: tuple[int, int, int]) -> tuple:
    """A layout with x, y and z at these offsets."""
    return 64, [TIME, *((name, kind, at, value) for (name, kind, _, value), at in zip(made.xyz(), places, strict=True))]


CLOUDS = {
    "big-endian": {"change": swapped},
    "rows with padding": {"height": 4, "change": padded},
    "row_step 0": {"row_step": 0},
    "NaN in an organised cloud": {"height": 4, "holes": math.nan},
    "doubles": {"layout": (64, [*made.xyz("f8"), TIME])},
    "other order of fields": {"layout": moved((40, 12, 24))},
    "times that are all 0": {"layout": times("u4", 0.0, name="t")},
    "no times": {"layout": (16, made.xyz())},
    "millimetres": {"layout": in_unit(1000.0)},
    "whole millimetres": {"layout": in_unit(1000.0, "i2")},
    "no return": {"layout": in_unit(math.nan)},
    "z taken for x, x for y": {"layout": moved((4, 8, 0))},
    "4 s": {"count": 40},
}


def rings(clockwise: bool, pitch_deg: float) -> tuple:
    """A drive of 14 s; the sensor leans by ``pitch_deg`` as tf says."""
    R = made.rotation(pitch=math.radians(pitch_deg), yaw=YAW)
    messages = [
        tf(START, "base_link", "lidar", MOUNTING, quaternion(YAW, 0.0, math.radians(pitch_deg)), topic="/tf_static")
    ]
    messages += drivers.readings(14.0)
    for begin in np.arange(0.0, 14.0, 0.1).tolist():
        turn = made.spinning(lambda t, begin=begin: pose_at(begin + t), MOUNTING, R, 16, 900, clockwise)
        messages.append(made.said("/points", START + begin, made.cloud(START + begin, turn, VELODYNE)))
    with TemporaryDirectory() as folder:
        _, error_m = drivers.outcome(save(Path(folder) / "run.mcap", messages))
    return f"{'clockwise' if clockwise else 'counter-clockwise'}, leaning by {pitch_deg:g} deg", 140, error_m


if __name__ == "__main__":
    main()
