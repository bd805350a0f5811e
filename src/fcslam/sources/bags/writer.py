"""Writes sensor records to a ROS bag."""

import sqlite3
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from fcslam.errors import InputError
from fcslam.records import (
    CameraImage,
    CameraModel,
    CloudScan,
    FloatArray,
    GnssFix,
    LaserScan,
    SensorRecord,
    Transform,
)
from fcslam.sources.bags.camera import image_format
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FIX,
    NANOSECONDS,
    ODOMETRY,
    SCAN,
    TRANSFORMS,
    MessageCodec,
    full_name,
)
from fcslam.sources.bags.transforms import in_space

if TYPE_CHECKING:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2

_ROS1, _MCAP, _SQLITE, _FOLDER = ".bag", ".mcap", ".db3", ""
_SUFFIXES = (_ROS1, _MCAP, _SQLITE, _FOLDER)
"""Formats of bags that can be written: ROS 1, two file formats of ROS 2, and a folder of ROS 2."""

_ODOM, _BASE, _LASER, _CAMERA = "odom", "base_link", "laser", "camera_optical_frame"
_GNSS = "gnss"
_SCAN_TOPIC = "/scan"
_FIRST_TOPICS = {"/odom": ODOMETRY, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS, _SCAN_TOPIC: SCAN}
"""Odometry first: at equal times it is read before the scan. Other topics begin with their first message."""
_IMAGE_TOPIC, _CAMERA_INFO_TOPIC = "/camera/image_raw/compressed", "/camera/camera_info"
_END_OF_TIME_S = 2**31


def write_bag(path: Path, records: Iterable[SensorRecord]) -> None:
    """Write ``records`` to ``path``; equal records give equal bytes.

    ``.bag`` is a ROS 1 bag, ``.mcap`` and ``.db3`` are files of ROS 2, a path without suffix is a new folder of
    ROS 2 with an MCAP file in it. The bag has these topics:

    - /scan, and /scan_2 and so on of further lasers;
    - /odom and /tf (odom -> base_link): odometry, also that of each scan and image at its stamp;
    - /camera/image_raw/compressed: images as they are encoded, each with its /camera/camera_info;
    - /tf_static (base_link -> laser, laser_2, camera_optical_frame): the mounting of lasers and camera.

    Header stamps are the records' own, to the nanosecond; the time of recording only ever grows. A scan whose beams
    were measured at different times has the stamp of the first one measured; if that is its last beam, the scan is
    written clockwise. The motion during a scan is not written, as it follows from the odometry.

    Raises:
        InputError: the bag cannot be written, its kind is not known, or ROS has no such stamp.
    """
    from rosbags import rosbag1, rosbag2

    ros1 = path.suffix == _ROS1
    if path.suffix not in _SUFFIXES:
        raise InputError(f"{path.name}: not a kind of bag; end it in .bag, .mcap or .db3, or in nothing for a folder")
    if path.suffix == _SQLITE and set("?#%") & set(str(path.absolute())):
        # rosbags puts the path into a URI as it is
        raise InputError(f"{path}: no .db3 can be written where a path holds ?, # or %; choose another path")
    plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix == _SQLITE else rosbag2.StoragePlugin.MCAP
    try:
        with TemporaryDirectory(prefix=".", dir=path.parent) as staging:
            place = Path(staging, path.stem)
            with rosbag1.Writer(place) if ros1 else rosbag2.Writer(place, version=9, storage_plugin=plugin) as writer:
                bag = _Bag(writer, ros1)
                for record in records:
                    bag.write(record)
            whole = place / f"{place.name}{path.suffix}" if path.suffix in (_MCAP, _SQLITE) else place
            whole.replace(path)
    except (OSError, sqlite3.Error, rosbag1.WriterError, rosbag2.WriterError) as error:
        raise InputError(f"{path}: cannot be written ({error}); choose another path") from error


class _Bag:
    def __init__(self, writer: "Writer1 | Writer2", ros1: bool) -> None:
        self._writer: Any = writer
        self._codec = MessageCodec(ros1)
        self._connections = {topic: self._connect(topic, kind) for topic, kind in _FIRST_TOPICS.items()}
        self._bag_time_ns = -1
        self._mounted: set[str] = set()
        self._mountings: list[tuple[float, float, float]] = []
        self._latest_reading: tuple[float, ...] = ()

    def write(self, item: SensorRecord) -> None:
        """Write one record: its odometry, and its scan or image."""
        stamp_ns = _nanoseconds(item.stamp)
        self._bag_time_ns = max(self._bag_time_ns + 1, stamp_ns)
        if isinstance(item, GnssFix):
            self._put_fix(stamp_ns, item)
            return
        if isinstance(item, CloudScan):
            raise ValueError("clouds of 3D LiDARs are not written")
        if item.T_odom_base is not None and not np.isnan(item.T_odom_base).all():
            self._put_odometry(stamp_ns, item.T_odom_base)
        if isinstance(item, LaserScan):
            self._put_scan(stamp_ns, item)
        elif isinstance(item, CameraImage):
            self._put_image(stamp_ns, item)

    def _put_odometry(self, stamp_ns: int, T_odom_base: FloatArray) -> None:
        reading = (stamp_ns, *T_odom_base.tolist())
        if reading != self._latest_reading:
            odom = self._codec.header(stamp_ns, _ODOM)
            make, transform = self._codec.make, in_space(T_odom_base)
            posed = make("geometry_msgs/PoseWithCovariance", pose=self._codec.pose(transform))
            self._put("/odom", ODOMETRY, make(ODOMETRY, header=odom, child_frame_id=_BASE, pose=posed))
            self._put("/tf", TRANSFORMS, self._codec.transforms(odom, _BASE, transform))
            self._latest_reading = reading

    def _put_scan(self, stamp_ns: int, scan: LaserScan) -> None:
        T_base_laser = scan.laser.T_base_laser
        if T_base_laser not in self._mountings:
            self._mountings.append(T_base_laser)
        number = self._mountings.index(T_base_laser) + 1
        suffix = f"_{number}" * (number > 1)
        self._mount(stamp_ns, _LASER + suffix, in_space(np.array(T_base_laser)))
        begin_s = 0.0 if scan.sweep is None else min(scan.sweep.first_s, scan.sweep.last_s)
        header = self._codec.header(stamp_ns + round(begin_s * NANOSECONDS), _LASER + suffix)
        self._put(_SCAN_TOPIC + suffix, SCAN, self._scan(header, scan))

    def _put_image(self, stamp_ns: int, image: CameraImage) -> None:
        try:
            encoding = image_format(image.encoded)
        except ValueError as error:
            raise InputError(f"an image at {image.stamp} s cannot be written ({error})") from error
        header = self._codec.header(stamp_ns, _CAMERA)
        self._mount(stamp_ns, _CAMERA, image.camera.T_base_camera)
        self._put(_CAMERA_INFO_TOPIC, CAMERA_INFO, self._camera_info(header, image.camera))
        data = np.frombuffer(image.encoded, dtype=np.uint8)
        self._put(
            _IMAGE_TOPIC,
            COMPRESSED_IMAGE,
            self._codec.make(COMPRESSED_IMAGE, header=header, format=encoding, data=data),
        )

    def _put_fix(self, stamp_ns: int, fix: GnssFix) -> None:
        header, make = self._codec.header(stamp_ns, _GNSS), self._codec.make
        self._mount(stamp_ns, _GNSS, in_space(np.array((*fix.antenna_xy, 0.0))))
        message = make(
            FIX,
            header=header,
            status=make("sensor_msgs/NavSatStatus", service=1),
            latitude=fix.latitude_deg,
            longitude=fix.longitude_deg,
            altitude=fix.altitude_m,
            position_covariance=fix.sigma_m**2 * np.eye(3).ravel(),
            position_covariance_type=2,
        )
        self._put("/fix", FIX, message)

    def _mount(self, stamp_ns: int, frame: str, T_base_frame: Transform) -> None:
        if frame not in self._mounted:
            header = self._codec.header(stamp_ns, _BASE)
            self._put("/tf_static", TRANSFORMS, self._codec.transforms(header, frame, T_base_frame))
            self._mounted.add(frame)

    def _connect(self, topic: str, kind: str) -> Any:
        return self._writer.add_connection(topic, full_name(kind), typestore=self._codec.store)

    def _put(self, topic: str, kind: str, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._connect(topic, kind)
        self._writer.write(self._connections[topic], self._bag_time_ns, self._codec.encode(message, kind))

    def _scan(self, header: Any, scan: LaserScan) -> Any:
        count, first_rad, increment_rad = scan.laser.beams
        last_rad = first_rad + scan.laser.beams.span_rad
        ranges_m = scan.ranges_m
        beam_s = 0.0 if scan.sweep is None else scan.sweep.duration_s / (count - 1)
        if scan.sweep is not None and scan.sweep.last_s < scan.sweep.first_s:
            first_rad, last_rad, increment_rad, ranges_m = last_rad, first_rad, -increment_rad, ranges_m[::-1]
        return self._codec.make(
            SCAN,
            header=header,
            angle_min=first_rad,
            angle_max=last_rad,
            angle_increment=increment_rad,
            time_increment=beam_s,
            scan_time=count * beam_s,
            range_max=scan.laser.max_range_m,
            ranges=np.ascontiguousarray(ranges_m),
        )

    def _camera_info(self, header: Any, camera: CameraModel) -> Any:
        """Pinhole model without distortion; names of matrices are capitals in ROS 1."""
        K = np.array([camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0])
        P = np.insert(K, (3, 6, 9), 0.0)
        matrices = {"D": np.zeros(5), "K": K, "R": np.eye(3).ravel(), "P": P}
        return self._codec.make(
            CAMERA_INFO,
            header=header,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            **{name if self._codec.ros1 else name.lower(): matrix for name, matrix in matrices.items()},
        )


def _nanoseconds(stamp: float) -> int:
    if not 0.0 <= stamp < _END_OF_TIME_S:
        raise InputError(f"a bag has no stamp {stamp:.6f} s; ROS counts from 0 s to {_END_OF_TIME_S} s")
    seconds = int(stamp)
    return seconds * NANOSECONDS + round((stamp - seconds) * NANOSECONDS)
