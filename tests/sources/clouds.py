"""Point clouds and depth images of a room, as drivers publish them; the ranges come from a ray caster of the tests."""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from fcslam.sources.bags.codec import CAMERA_INFO, IMAGE, POINT_CLOUD
from tests import spinning_lidar
from tests.sources.bag_messages import CODECS, Said, header

ROOM = np.array([[-3.0, -2.0, 0.0], [5.0, 4.0, 2.5]])
"""Lowest and highest corner."""
BOXES = np.array(
    [
        [[2.0, -1.5, 0.0], [2.5, -0.5, 0.5]],  # a crate
        [[-2.5, 1.0, 0.7], [-1.0, 2.5, 0.74]],  # a table top, above the band
        [[-1.0, -1.8, 0.0], [-0.8, -1.6, 0.05]],  # a sill, below the band
    ]
)
NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
PERIOD_S = 0.1


def rotation(roll=0.0, pitch=0.0, yaw=0.0):
    """A turn about x, then y, then z."""
    return Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix()


def cast(origins, directions):
    """Ranges of rays from inside the room, shape (N,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.maximum((ROOM[0] - origins) / directions, (ROOM[1] - origins) / directions).min(axis=1)
    return np.minimum(walls, spinning_lidar.cast(BOXES, origins, directions))


def plan_ranges(x, y, angles):
    """Ranges of a scanner in the band at (x, y), one place or one for each beam, along ``angles``."""
    directions = np.stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)), axis=1)
    return cast(np.stack(np.broadcast_arrays(x, y, np.full_like(angles, 0.3)), axis=1), directions)


class Measured(NamedTuple):
    """Returns of one cloud in the order of the driver."""

    points: np.ndarray
    times: np.ndarray
    """After the beginning of the turn, seconds."""


def spinning(pose_at, mounting=(0.0, 0.0, 0.4), R=None, rings=16, columns=1800, clockwise=False, first_rad=-math.pi):
    """A turn of a scanner; ``pose_at(times)`` are the poses of the base, shape (N, 3)."""
    elevations = np.radians(np.linspace(-15.0, 15.0, rings))
    times = np.repeat(np.arange(columns) / columns * PERIOD_S, rings)
    azimuths = first_rad + (-1.0 if clockwise else 1.0) * times / PERIOD_S * 2.0 * math.pi
    elevations = np.tile(elevations, columns)
    return _measured(_unit(azimuths, elevations), times, pose_at, mounting, R)


def scattered(pose_at, count=20000, mounting=(0.0, 0.0, 0.4), R=None):
    """A cloud whose directions follow no order."""
    rng = np.random.default_rng(5)
    times = np.arange(count) / count * PERIOD_S
    directions = _unit(rng.uniform(-math.pi, math.pi, count), np.radians(rng.uniform(-7.0, 52.0, count)))
    return _measured(directions, times, pose_at, mounting, R)


def at_rest(times):
    return np.zeros((len(times), 3))


def _unit(azimuths, elevations):
    flat = np.cos(elevations)
    return np.stack((flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(elevations)), axis=1)


def _measured(directions, times, pose_at, mounting, R):
    R = np.eye(3) if R is None else R
    x, y, theta = pose_at(times).T
    c, s = np.cos(theta), np.sin(theta)
    in_base = directions @ R.T

    def in_world(v):
        return np.stack((c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]), axis=1)

    origins = in_world(np.tile(mounting, (len(times), 1))) + np.stack((x, y, np.zeros_like(x)), axis=1)
    return Measured(directions * cast(origins, in_world(in_base))[:, None], times)


def cloud(stamp, measured, layout, frame="lidar", height=1, ros1=False, **changes):
    """A message with the fields of ``layout``: name, type, offset and value of each; ``changes`` are to its fields."""
    step, fields = layout
    names = {name: (kind, offset) for name, kind, offset, _ in fields}
    dtype = np.dtype(
        {
            "names": list(names),
            "formats": [f"<{kind}" for kind, _ in names.values()],
            "offsets": [offset for _, offset in names.values()],
            "itemsize": step,
        }
    )
    values = np.zeros(len(measured.points), dtype)
    for name, _, _, value in fields:
        values[name] = value(measured)
    make = CODECS[ros1].make
    named = {
        "header": header(stamp, frame, ros1),
        "height": height,
        "width": len(values) // height,
        "fields": [
            make("sensor_msgs/PointField", name=name, offset=offset, datatype=NUMBERS[kind], count=1)
            for name, kind, offset, _ in fields
        ],
        "point_step": step,
        "row_step": step * (len(values) // height),
        "data": values.view(np.uint8).reshape(-1),
    }
    return make(POINT_CLOUD, **{**named, **changes})


def xyz(kind="f4"):
    size = int(kind[1])
    return [
        (name, kind, size * axis, lambda measured, axis=axis: measured.points[:, axis])
        for axis, name in enumerate("xyz")
    ]


def said(topic, stamp, message, kind=POINT_CLOUD, ros1=False):
    return Said(topic, kind, stamp + PERIOD_S, {"payload": CODECS[ros1].encode(message, kind)})


def depth_image(stamp, encoding, pitch=0.0, height_m=0.3, width=160, height=120, fx=95.0):
    """The room seen along x by a camera at the origin, that looks down by ``pitch``, and its calibration."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack(((u - width / 2) / fx, (v - height / 2) / fx, np.ones_like(u)), axis=-1).reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)
    directions = rays / lengths[:, None] @ (rotation(pitch=pitch) @ OPTICAL).T
    depth = cast(np.tile([0.0, 0.0, height_m], (len(rays), 1)), directions) / lengths
    pixels = (depth * 1000.0).round().astype("<u2") if encoding == "16UC1" else depth.astype("<f4")
    make, size = CODECS[False].make, {"width": width, "height": height}
    size["header"] = header(stamp, "depth_optical_frame")
    data = pixels.view(np.uint8).reshape(-1)
    image = make(IMAGE, **size, encoding=encoding, step=width * pixels.itemsize, data=data)
    return image, make(CAMERA_INFO, **size, k=np.array([fx, 0, width / 2, 0, fx, height / 2, 0, 0, 1.0]))


def _none(_measured):
    return 0


def _one(_measured):
    return 1


STAMP = 1_700_000_000.25
VELODYNE = 22, [*xyz(), ("intensity", "f4", 12, _one), ("ring", "u2", 16, _none),
                ("time", "f4", 18, lambda m: m.times)]  # fmt: skip
VELODYNE_FROM_END = 22, [*xyz(), ("time", "f4", 18, lambda m: m.times - PERIOD_S)]
OUSTER = 48, [*xyz(), ("intensity", "f4", 16, _one), ("t", "u4", 20, lambda m: np.round(m.times * 1e9)),
              ("reflectivity", "u2", 24, _none), ("ring", "u2", 26, _none),
              ("ambient", "u2", 28, _none), ("range", "u4", 32, _none)]  # fmt: skip
HESAI = 26, [*xyz(), ("intensity", "f4", 12, _one), ("timestamp", "f8", 16, lambda m: STAMP + m.times),
             ("ring", "u2", 24, _none)]  # fmt: skip
OTHER_CLOCK = 26, [*xyz(), ("timestamp", "f8", 16, lambda m: 77.5 + m.times)]
LIVOX = 26, [*xyz(), ("intensity", "f4", 12, _one), ("tag", "u1", 16, _none),
             ("line", "u1", 17, _none), ("timestamp", "f8", 18, lambda m: (STAMP + m.times) * 1e9)]  # fmt: skip
REALSENSE = 20, [*xyz(), ("rgb", "f4", 16, _none)]
DOUBLES = 32, [*xyz("f8"), ("intensity", "f8", 24, _one)]
