"""Point clouds and depth images of a bag or a live robot as scans; invalid messages raise ValueError."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from fcslam.records import FloatArray, Transform
from fcslam.sources.bags.camera import Calibration, pixel_rows
from fcslam.sources.bags.codec import IMAGE, POINT_CLOUD
from fcslam.sources.bags.messages import LONGEST_SWEEP_S, header_of
from fcslam.sources.bags.options import GivenPose
from fcslam.sources.bags.transforms import in_space, planar
from fcslam.sources.gate import MAX_STEP_BACK_S
from fcslam.sources.point_clouds import SPACING_RAD, CloudMounting, PointCloud

MOST_POINTS: Final = 4_000_000
"""In one message; the largest scanners measure a tenth of it in a turn."""
_TYPES: Final = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""Types of sensor_msgs/PointField, by their number."""
TIMES: Final = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "timeoffset", "ts")
_UNITS_S: Final = (1.0, 1e-3, 1e-6, 1e-9)
_SHORTEST_CLOUD_S: Final = 5e-3
"""Least time between the first and the last point of a cloud; it shows the unit of the times."""
_OVER_INTERVAL: Final = 1.2
"""Largest ratio of the duration of a cloud to the time between two clouds."""
_LONGEST_IN_SECONDS: Final = 0.9
"""Times of points that are seconds span less: from 0 to 1 they are shares of a turn."""
_REACH: Final = 4.0
"""Times farther from the middle half of all than this many times its duration are wrong, as after lost packets."""
_SCATTERED: Final = 20.0
"""Ratio of the middle half of all times to the shortest half that no turn has."""
_DEPTHS: Final = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Type and unit of the pixels of a depth image, by its encoding."""
_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of the optical frame of a camera that looks along x (REP 103)."""
_UP: Final = 0.7
"""Height of the optical axis of a camera that looks up, per metre."""


def cloud_mounting(T_base_sensor: Transform, kind: str, frame: str) -> tuple[CloudMounting, str]:
    """The mounting that tf has, of a sensor with messages of type ``kind`` in ``frame``, and what is wrong with it."""
    rotation, note = T_base_sensor.rotation_matrix(), ""
    if kind == IMAGE and "optical" not in frame and rotation[2, 2] > _UP:
        rotation = rotation @ _OPTICAL
        note = (
            f"looks up, so '{frame}' is not its optical frame; corrected: publish a frame with roll -90 and yaw -90 "
            "deg in it, and name that in the images"
        )
    return CloudMounting(rotation, np.array(T_base_sensor.translation_m), planar(T_base_sensor)[2]), note


def given_cloud_mounting(pose: GivenPose, kind: str, frame: str) -> CloudMounting:
    """The mounting that the user gives, without a height; the sensor is level."""
    x, y, theta, *upside_down = pose
    mounting, _ = cloud_mounting(in_space(np.array([x, y, theta])), POINT_CLOUD, frame)
    turn = np.diag([1.0, -1.0, -1.0]) if any(upside_down) else np.eye(3)
    axes = _OPTICAL if kind == IMAGE or "optical" in frame else np.eye(3)
    return mounting._replace(rotation=mounting.rotation @ turn @ axes, is_height_known=False)


def cloud_of(
    content: Any,
    kind: str,
    bag_time_ns: int,
    calibration: Calibration | None = None,
    longest_s: float = LONGEST_SWEEP_S,
) -> PointCloud:
    """Convert a message of type ``kind``: a point cloud, or a depth image with its calibration.

    A cloud takes at most ``longest_s``, as it ends before the next one.
    """
    stamp, frame = header_of(content.header, bag_time_ns)
    if kind == IMAGE:
        return PointCloud(stamp, frame, _depth_points(content, calibration), np.empty(0))
    if kind == POINT_CLOUD:
        return measured_cloud(stamp, frame, *_fields(content), longest_s)
    points = np.array([(each.x, each.y, each.z) for each in content.points], np.float64).reshape(-1, 3)
    times = np.array([each.offset_time for each in content.points], np.int64)
    return measured_cloud(stamp, frame, points, times, longest_s)


def measured_cloud(stamp: float, frame: str, points: FloatArray, times: Any, longest_s: float) -> PointCloud:
    """The cloud of the points that are returns, with their ``times`` as they are sent; None: it has none."""
    measured = np.isfinite(points).all(axis=1) & points.any(axis=1)
    cloud = PointCloud(stamp, frame, points[measured], np.empty(0))
    if times is None:
        return cloud
    exact = times.astype(np.float64 if times.dtype.kind == "f" else np.int64)  # differences of unsigned ones wrap
    return _timed(cloud, exact[measured], longest_s)


def _fields(content: Any) -> tuple[FloatArray, Any]:
    """Points, shape (N, 3), and their times as they are sent, shape (N,), or None."""
    width, height, step, data = content.width, content.height, content.point_step, content.data
    row_bytes = content.row_step if height > 1 else width * step
    if width * height > MOST_POINTS:
        raise ValueError(f"width {width} and height {height} are too large for a point cloud")
    if not step or row_bytes < width * step or len(data) < height * row_bytes:
        raise ValueError(
            f"{len(data)} bytes of data do not hold {height} rows of {width} points with point_step {step} and "
            f"row_step {content.row_step}"
        )
    order = ">" if content.is_bigendian else "<"
    types = {}
    for each in content.fields:
        name = each.name
        if name not in ("x", "y", "z", *TIMES) or name in types:
            continue
        if not 0 < each.datatype < len(_TYPES):
            raise ValueError(f"field {name} has the datatype {each.datatype}, which does not exist")
        kind = np.dtype(order + _TYPES[each.datatype])
        if each.offset + kind.itemsize > step:
            raise ValueError(f"field {name} at offset {each.offset} is outside of point_step {step}")
        types[name] = kind, each.offset
    if missing := [name for name in "xyz" if name not in types or types[name][0].kind != "f"]:
        raise ValueError(f"field {missing[0]} is missing or not a float")
    layout = np.dtype(
        {
            "names": list(types),
            "formats": [kind for kind, _ in types.values()],
            "offsets": [offset for _, offset in types.values()],
            "itemsize": step,
        }
    )
    rows = np.frombuffer(data, np.uint8, height * row_bytes).reshape(height, row_bytes)[:, : width * step]
    values = np.ascontiguousarray(rows).reshape(-1).view(layout)
    points: FloatArray = np.stack([values[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return points, next((values[name] for name in TIMES if name in types), None)


def longest_cloud_s(headers: Iterable[tuple[float, str]]) -> float:
    """The longest time that a cloud takes, by stamps and frames of some: it ends before the next one of its sensor."""
    stamps: dict[str, list[float]] = {}
    for stamp, frame in headers:
        stamps.setdefault(frame, []).append(stamp)
    steps_s = np.concatenate([np.empty(0), *map(np.diff, stamps.values())])
    steps_s = steps_s[steps_s > 0.0]
    return min(_OVER_INTERVAL * float(np.median(steps_s)), LONGEST_SWEEP_S) if len(steps_s) else LONGEST_SWEEP_S


def notes_on_times(topic: str, kind: str, clouds: Sequence[PointCloud], is_whole: bool) -> Iterator[str]:
    """What is wrong with the times of the points in these clouds, but that whole ones have none (``reader_of``)."""
    left_out = sum(cloud.left_out for cloud in clouds)
    if left_out:
        share = left_out / (left_out + sum(len(cloud.points) for cloud in clouds))
        yield f"{share:.1%} of the points of {topic} are left out, as their times are far from those of the others"
    if kind != IMAGE and not is_whole and not any(len(cloud.times_s) for cloud in clouds):
        is_in_order = any(cloud.is_in_order for cloud in clouds)
        times = "times that are no seconds and count as their order" if is_in_order else "no times, or all the same"
        yield (
            f"the points of {topic} have {times}, so the motion of the robot during a cloud is corrected only if a "
            "recording shows how the sensor turns; let the driver publish them"
        )


def _timed(cloud: PointCloud, times: Any, longest_s: float) -> PointCloud:
    """The cloud with the times of its points, of any usual unit and beginning; points with wrong times are left out.

    Times that are none in any unit, as shares of a turn, give only the order of the points.
    """
    known = np.isfinite(times)
    if not known.any():
        return cloud
    ordered = np.sort(times[known])
    half = len(ordered) // 2
    after, ordered = ((each - ordered[half]).astype(np.float64) for each in (times, ordered))
    low, high = np.quantile(ordered, (0.25, 0.75)).tolist()
    widths = ordered[half:] - ordered[: len(ordered) - half]
    shortest = int(np.argmin(widths))
    if 0.0 < widths[shortest] * _SCATTERED < high - low:  # wrong times are in the middle half, too
        low, high = float(ordered[shortest]), float(ordered[shortest + half])
    if low == high:
        return cloud
    is_near = np.abs(after - 0.5 * (low + high)) < (0.5 + _REACH) * (high - low)  # false for NaN
    points, times, after = cloud.points[is_near], times[is_near], after[is_near]
    low, high = np.quantile(after, (0.25, 0.75)).tolist()  # they show the unit
    cloud = cloud._replace(points=points, left_out=int(np.count_nonzero(~is_near)))
    for unit_s in _UNITS_S:
        most_s = min(longest_s, _LONGEST_IN_SECONDS) if unit_s == 1.0 else longest_s
        if _SHORTEST_CLOUD_S <= 2.0 * (high - low) * unit_s <= most_s:
            break
    else:
        return cloud._replace(points=points[np.argsort(after, kind="stable")], is_in_order=True)
    first_s = float(times.min()) * unit_s
    begin_s = min(first_s, first_s - cloud.stamp, key=abs)
    if abs(begin_s) > MAX_STEP_BACK_S:
        begin_s = 0.0  # by another clock: the stamp is that of the first point
    return cloud._replace(times_s=begin_s + (after - after.min()) * unit_s)


def _depth_points(content: Any, calibration: Calibration | None) -> FloatArray:
    """The points of a depth image in the optical frame of its camera (z forward, y down), shape (N, 3).

    Pixels without a finite depth above 0 are left out, and so are rows closer together than a scan needs.
    """
    if content.encoding not in _DEPTHS:
        raise ValueError(f"the encoding '{content.encoding}' is not that of a depth image, 16UC1 or 32FC1")
    if calibration is None:
        raise ValueError("no calibration (camera_info) of the depth image")
    kind, unit_m = _DEPTHS[content.encoding]
    pixel = np.dtype((">" if content.is_bigendian else "<") + kind)
    camera = calibration.camera
    across, down = content.width / camera.width, content.height / camera.height  # of images that were made smaller
    pixels = pixel_rows(content, pixel.itemsize).view(pixel)
    rows = np.arange(0, len(pixels), max(1, int(camera.fy * down * SPACING_RAD)))
    z = pixels[rows].astype(np.float64) * unit_m
    x = (np.arange(content.width) - camera.cx * across) / (camera.fx * across) * z
    y = (rows[:, None] - camera.cy * down) / (camera.fy * down) * z
    points: FloatArray = np.stack((x, y, z), axis=-1)[np.isfinite(z) & (z > 0.0)]
    return points
