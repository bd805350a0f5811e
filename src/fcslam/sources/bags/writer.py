"""Sensor records written as a ROS bag."""

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from math import cos, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from fcslam.errors import OutputError
from fcslam.records import CameraImage, FloatArray, LaserModel, LaserScan, Odometry, SensorRecord
from fcslam.sources.bags.container import ODOMETRY, SCAN, TRANSFORMS, typestore

if TYPE_CHECKING:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2

_ROS1, _MCAP, _SQLITE, _FOLDER = ".bag", ".mcap", ".db3", ""
BAG_SUFFIXES = (_ROS1, _MCAP, _SQLITE, _FOLDER)
"""The kinds of bags that can be written: ROS 1, two files of ROS 2, and a folder of ROS 2."""

_ODOM, _BASE, _LASER = "odom", "base_link", "laser"
_TOPICS = {"/odom": ODOMETRY, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS, "/scan": SCAN}
"""Odometry first: at equal times it is read before the scan."""
_END_OF_TIME_S = 2**31
_NANOSECONDS = 10**9


def write_bag(path: Path, records: Iterable[SensorRecord]) -> None:
    """Write ``records`` to ``path``; equal records give equal bytes.

    ``.bag`` is a ROS 1 bag, ``.mcap`` and ``.db3`` are files of ROS 2, a path without suffix is a new folder of
    ROS 2 with an MCAP file in it. Scans go to /scan; odometry, and that of each scan at its stamp, to /odom and /tf
    (odom -> base_link); the laser's pose to /tf_static (base_link -> laser). Header stamps are the records' own, to
    the nanosecond; the time of recording only ever grows.

    Raises:
        OutputError: the bag cannot be written, its kind is not known, or ROS has no such stamp.
    """
    from rosbags import rosbag1, rosbag2

    try:
        with _opened(path) as bag:
            for record in records:
                if not isinstance(record, CameraImage):
                    bag.write(record)
    except (OSError, sqlite3.Error, rosbag1.WriterError, rosbag2.WriterError) as error:
        raise OutputError(f"{path}: cannot be written ({error}); choose another path") from error


@contextmanager
def _opened(path: Path) -> Iterator["_Bag"]:
    """A bag to write to, which takes its place when it is complete."""
    from rosbags import rosbag1, rosbag2

    if path.suffix not in BAG_SUFFIXES:
        raise OutputError(f"{path}: no kind of bag; end it in .bag, .mcap or .db3, or in nothing for a folder")
    if path.suffix == _SQLITE and set("?#%") & set(str(path.absolute())):
        # rosbags puts the path into a URI as it is
        raise OutputError(f"{path}: no .db3 can be written where a path holds ?, # or %; choose another path")
    with TemporaryDirectory(prefix=".", dir=path.parent) as staging:
        place = Path(staging, path.stem)
        if path.suffix == _ROS1:
            with rosbag1.Writer(place) as writer1:
                yield _Bag(writer1, ros1=True)
        else:
            plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix == _SQLITE else rosbag2.StoragePlugin.MCAP
            with rosbag2.Writer(place, version=9, storage_plugin=plugin) as writer2:
                yield _Bag(writer2, ros1=False)
        whole = place / f"{place.name}{path.suffix}" if path.suffix in (_MCAP, _SQLITE) else place
        whole.replace(path)


class _Bag:
    """Turns records into messages."""

    def __init__(self, writer: "Writer1 | Writer2", ros1: bool) -> None:
        self._writer: Any = writer
        self._store = typestore(ros1)
        self._ros1 = ros1
        self._connections = {topic: self._connect(topic, kind) for topic, kind in _TOPICS.items()}
        self._bag_time_ns = -1
        self._has_laser = False
        self._latest_reading: tuple[float, ...] = ()

    def write(self, record: LaserScan | Odometry) -> None:
        """Write what one record says: its odometry, and its scan if it is one."""
        stamp_ns = _nanoseconds(record.stamp)
        self._bag_time_ns = max(self._bag_time_ns + 1, stamp_ns)
        reading = (stamp_ns, *record.T_odom_base.tolist())
        if reading != self._latest_reading:
            odom = self._header(stamp_ns, _ODOM)
            self._put("/odom", self._odometry(odom, record.T_odom_base))
            self._put("/tf", self._transforms(odom, _BASE, record.T_odom_base))
            self._latest_reading = reading
        if isinstance(record, LaserScan):
            if not self._has_laser:
                mounting = np.array(record.laser.T_base_laser)
                self._put("/tf_static", self._transforms(self._header(stamp_ns, _BASE), _LASER, mounting))
                self._has_laser = True
            self._put("/scan", self._scan(self._header(stamp_ns, _LASER), record))

    def _connect(self, topic: str, kind: str) -> Any:
        return self._writer.add_connection(topic, _full(kind), typestore=self._store)

    def _put(self, topic: str, message: Any) -> None:
        serialize = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        payload = serialize(message, _full(_TOPICS[topic]))
        self._writer.write(self._connections[topic], self._bag_time_ns, payload)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[_full(kind)](**fields)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, _NANOSECONDS)
        stamp = self._make("builtin_interfaces/Time", sec=seconds, nanosec=nanoseconds)
        count = {"seq": 0} if self._ros1 else {}
        return self._make("std_msgs/Header", stamp=stamp, frame_id=frame, **count)

    def _rotation(self, pose: FloatArray) -> Any:
        half_rad = 0.5 * float(pose[2])
        return self._make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=sin(half_rad), w=cos(half_rad))

    def _vector(self, kind: str, x: float = 0.0, y: float = 0.0) -> Any:
        return self._make(f"geometry_msgs/{kind}", x=x, y=y, z=0.0)

    def _odometry(self, header: Any, T_odom_base: FloatArray) -> Any:
        unknown = np.zeros(36)
        position = self._vector("Point", *T_odom_base[:2].tolist())
        pose = self._make("geometry_msgs/Pose", position=position, orientation=self._rotation(T_odom_base))
        twist = self._make("geometry_msgs/Twist", linear=self._vector("Vector3"), angular=self._vector("Vector3"))
        return self._make(
            ODOMETRY,
            header=header,
            child_frame_id=_BASE,
            pose=self._make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=unknown),
            twist=self._make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=unknown),
        )

    def _transforms(self, header: Any, child: str, T_parent_child: FloatArray) -> Any:
        translation = self._vector("Vector3", *T_parent_child[:2].tolist())
        transform = self._make(
            "geometry_msgs/Transform", translation=translation, rotation=self._rotation(T_parent_child)
        )
        stamped = self._make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform)
        return self._make(TRANSFORMS, transforms=[stamped])

    def _scan(self, header: Any, scan: LaserScan) -> Any:
        laser: LaserModel = scan.laser
        return self._make(
            SCAN,
            header=header,
            angle_min=laser.angle_min_rad,
            angle_max=laser.angle_min_rad + (laser.beam_count - 1) * laser.angle_increment_rad,
            angle_increment=laser.angle_increment_rad,
            time_increment=0.0,
            scan_time=0.0,
            range_min=0.0,
            range_max=laser.max_range_m,
            ranges=np.where(scan.ranges_m >= laser.max_range_m, np.float32(np.inf), scan.ranges_m),
            intensities=np.zeros(0, dtype=np.float32),
        )


def _nanoseconds(stamp: float) -> int:
    if not 0.0 <= stamp < _END_OF_TIME_S:
        raise OutputError(f"a bag has no stamp {stamp:.6f} s; ROS counts from 0 s to {_END_OF_TIME_S} s")
    seconds = int(stamp)
    return seconds * _NANOSECONDS + round((stamp - seconds) * _NANOSECONDS)


def _full(kind: str) -> str:
    return kind.replace("/", "/msg/")
