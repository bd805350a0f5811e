"""The outputs of a robot to the ROS network: map, pose, path, closures, tf and diagnostics.

Frames follow REP 105. The robot publishes ``map -> odom``; the driver of the base publishes ``odom -> base``.
"""

import threading
from collections.abc import Mapping, Sequence
from math import hypot
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import FloatArray
from fcslam.ros.network import Publish, Quality, RosNetwork
from fcslam.ros.topics import resolved
from fcslam.sources.bags.codec import POINT_CLOUD, TRANSFORMS, MessageCodec
from fcslam.sources.bags.transforms import in_space

if TYPE_CHECKING:
    from fcslam.wire.fleet_replies import QualityReply, TeammatePose

GRID, POSE, PATH = "nav_msgs/OccupancyGrid", "geometry_msgs/PoseWithCovarianceStamped", "nav_msgs/Path"
MARKERS, DIAGNOSTICS = "visualization_msgs/MarkerArray", "diagnostic_msgs/DiagnosticArray"
MARKER, STATUS = "visualization_msgs/Marker", "diagnostic_msgs/DiagnosticStatus"

POSES, POSE_STAMPED = "geometry_msgs/PoseArray", "geometry_msgs/PoseStamped"

MAP: Final = "map"
"""Topic of the map in the robot's namespace."""
POINTS: Final = "cloud_map"
"""Topic of the points of a map in space; other programs call it so, too."""
_FLOAT32: Final = 7
"""Number of this type in sensor_msgs/PointField."""
OWN_MAP: Final = "own_map"
"""Topic of what a robot of a fleet saw itself."""
FLEET_POSES, FLEET_STATUS = "fleet/poses", "fleet/status"
FLEET_FRONTIERS, FLEET_GOAL = "fleet/frontiers", "fleet/goal"
FLEET_QUALITY = "fleet/quality"
DIAGNOSTICS_TOPIC: Final = "/diagnostics"
MOST_TEAMMATES: Final = 64
"""Robots with a topic of their own; the others are in ``fleet/poses`` only."""
LATCHED: Final = Quality(reliable=True, latched=True, depth=1)
STREAMED: Final = Quality(reliable=True, depth=10)
TRANSFORMED: Final = Quality(reliable=True, depth=100)

_GRID_VALUES: Final = np.array([-1, 0, 100], np.int8)
"""Values of ROS by ``Occupancy``."""
PATH_STEP_M: Final = 0.1
"""Least distance between two poses of the published path."""
LONGEST_PATH: Final = 5000
"""Most poses of the published path, about; a longer path has longer steps."""
LINE_WIDTH_M: Final = 0.05
SPHERE_M: Final = 0.3


class Outputs:
    """The publishers of one robot. Any thread may call."""

    def __init__(self, network: RosNetwork, namespace: str, map_frame: str, tf: str, in_space: bool = False) -> None:
        """``tf``: topic of the transforms; ``in_space``: whether the topic of the points begins, so others find it.

        Topics without a leading slash are in the namespace.
        """
        self._network, self._namespace, self._map_frame, self._tf = network, namespace, map_frame, tf
        self._codec = MessageCodec(ros1=False)
        self._levels, self._shapes = self._codec.type_of(STATUS), self._codec.type_of(MARKER)
        self._lock = threading.Lock()
        self._publishers: dict[str, Publish] = {}
        """By topic; new ones are made under the lock."""
        self._maps: dict[str, OccupancyMap] = {}
        self._teammates: dict[str, str] = {}
        """Robots by the topics of their poses."""
        self._goal_xy: FloatArray = np.full(2, np.nan)
        for topic, kind, quality in (
            (MAP, GRID, LATCHED),
            ("pose", POSE, STREAMED),
            ("path", PATH, LATCHED),
            ("closures", MARKERS, LATCHED),
            (tf, TRANSFORMS, TRANSFORMED),
            (DIAGNOSTICS_TOPIC, DIAGNOSTICS, STREAMED),
            *[(POINTS, POINT_CLOUD, LATCHED)] * in_space,
        ):
            self._publisher(topic, kind, quality)

    def transform(self, stamp_ns: int, odom_frame: str, T_map_odom: FloatArray) -> None:
        """Publish ``map -> odom`` for this stamp."""
        header = self._codec.header(stamp_ns, self._map_frame)
        self._send(self._tf, TRANSFORMS, self._codec.transforms(header, odom_frame, in_space(T_map_odom)))

    def pose(self, stamp_ns: int, T_map_base: FloatArray, covariance: FloatArray) -> None:
        """Publish the pose (P,) of a scan with its covariance (6, 6)."""
        make, pose = self._codec.make, self._codec.pose(in_space(T_map_base))
        posed = make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.array(covariance.ravel()))
        header = self._codec.header(stamp_ns, self._map_frame)
        self._send("pose", POSE, make(POSE, header=header, pose=posed))

    def path(self, stamp_ns: int, stamps: FloatArray, T_map_base: FloatArray) -> None:
        """Publish the path: stamps (N,) in seconds and poses (N, P), thinned to steps of at least ``PATH_STEP_M``."""
        poses = [self._posed(nanoseconds(stamps[at]), T_map_base[at]) for at in _steps(T_map_base)]
        header = self._codec.header(stamp_ns, self._map_frame)
        self._send("path", PATH, self._codec.make(PATH, header=header, poses=poses))

    def closures(self, stamp_ns: int, ends_xy: FloatArray) -> None:
        """Publish the accepted closures as lines between two places (N, 2, 2), metres in ``map``."""
        lines = self._marker(stamp_ns, "closures", self._shapes.LINE_LIST, LINE_WIDTH_M, (0.1, 0.6, 0.2), ends_xy)
        self._send("closures", MARKERS, self._codec.make(MARKERS, markers=[lines]))

    def frontiers(self, now_ns: int, free_xy: FloatArray, taken_xy: FloatArray, T_map_goal: FloatArray | None) -> None:
        """Publish where the map can be explored further, and where this robot shall go if that changed.

        Frontiers that no robot has, and those that robots have, have shape (N, 2), metres in ``map``.
        """
        markers = [
            self._marker(now_ns, name, self._shapes.SPHERE_LIST, SPHERE_M, colour, points)
            for name, colour, points in (("free", (0.9, 0.6, 0.1), free_xy), ("taken", (0.1, 0.4, 0.9), taken_xy))
        ]
        self._send(FLEET_FRONTIERS, MARKERS, self._codec.make(MARKERS, markers=markers), LATCHED)
        self._publisher(FLEET_GOAL, POSE_STAMPED, LATCHED)
        if T_map_goal is not None and not np.array_equal(T_map_goal[:2], self._goal_xy):
            self._goal_xy = T_map_goal[:2]
            self._send(FLEET_GOAL, POSE_STAMPED, self._posed(now_ns, T_map_goal), LATCHED)

    def quality(self, now_ns: int, robot: str, maps: "Sequence[QualityReply]") -> None:
        """Publish how good the map of a robot is, by its certificate."""
        statuses = [
            self._status(
                f"map {one.map_index}",
                robot,
                self._levels.WARN if one.drives else self._levels.OK,
                one.verdict,
                {
                    "map": one.map_index,
                    "bar_m": one.bar_m,
                    "within_m": one.within_m,
                    "error_95_m": one.error_95_m,
                    "good_share": one.good_share,
                    **{f"drive_{number}": text for number, text in enumerate(one.drives, 1)},
                },
            )
            for one in maps
        ]
        self._diagnose(FLEET_QUALITY, now_ns, statuses, LATCHED)

    def points(self, stamp_ns: int, points: FloatArray) -> None:
        """Publish the points (N, 3) of the map in space."""
        make, count = self._codec.make, len(points)
        message = make(
            POINT_CLOUD,
            header=self._codec.header(stamp_ns, self._map_frame),
            height=1,
            width=count,
            fields=[
                make("sensor_msgs/PointField", name=axis, offset=4 * k, datatype=_FLOAT32, count=1)
                for k, axis in enumerate("xyz")
            ],
            is_bigendian=False,
            point_step=12,
            row_step=12 * count,
            data=np.frombuffer(points.astype("<f4").tobytes(), np.uint8),
            is_dense=True,
        )
        self._send(POINTS, POINT_CLOUD, message, LATCHED)

    def map(self, stamp_ns: int, occupancy: OccupancyMap, topic: str = MAP) -> bool:
        """Publish a map if it changed; returns whether it did."""
        before = self._maps.get(topic)
        if before is not None and _is_same(before, occupancy):
            return False
        self._maps[topic] = occupancy
        height, width = occupancy.cells.shape
        info = self._codec.make(
            "nav_msgs/MapMetaData",
            map_load_time=self._codec.time(stamp_ns),
            resolution=occupancy.resolution_m,
            width=width,
            height=height,
            origin=self._codec.pose(in_space(np.array((*occupancy.origin_xy, 0.0)))),
        )
        header = self._codec.header(stamp_ns, self._map_frame)
        data = _GRID_VALUES[occupancy.cells].ravel()
        self._send(topic, GRID, self._codec.make(GRID, header=header, info=info, data=data), LATCHED)
        return True

    def fleet(self, now_ns: int, teammates: "Sequence[TeammatePose]", own: int | None) -> None:
        """Publish where the robots of the own map are, and which of all robots, this one as well, are in which map.

        ``own`` is the index of the robot's own map; None: no pose is in its frame.
        """
        near = [mate.T_map_base for mate in teammates if mate.map_index == own]
        poses = [self._codec.pose(in_space(np.array(T_map_base))) for T_map_base in near]
        header = self._codec.header(now_ns, self._map_frame)
        self._send(FLEET_POSES, POSES, self._codec.make(POSES, header=header, poses=poses))
        statuses = []
        for mate in teammates:
            topic, is_near = _pose_topic(mate.robot), mate.map_index == own
            if is_near and len(self._teammates) < MOST_TEAMMATES:
                self._teammates.setdefault(topic, mate.robot)
            owner = self._teammates.get(topic)
            if is_near and owner == mate.robot:
                stamp_ns = max(0, now_ns - nanoseconds(mate.age_s))
                self._send(topic, POSE_STAMPED, self._posed(stamp_ns, np.array(mate.T_map_base)))
            values: dict[str, object] = {"map": mate.map_index, "floor": mate.floor, "age_s": f"{mate.age_s:.2f}"}
            values |= {axis: f"{at:.4f}" for axis, at in zip(("x", "y", "theta"), mate.T_map_base, strict=True)}
            name, where, level = f"robot {mate.robot}", f"map {mate.map_index}", self._levels.OK
            if owner not in (None, mate.robot):  # as of r-2 and r_2
                where, level = f"{where}; {topic} has the poses of {owner}: rename one of both", self._levels.WARN
            statuses.append(self._status(name, mate.robot, level, where, values))
        self._diagnose(FLEET_STATUS, now_ns, statuses)

    def diagnostics(self, stamp_ns: int, robot: str, trouble: str, values: Mapping[str, object], well: str) -> None:
        """Publish the state of the robot: ``trouble``, or ``well`` if that is empty."""
        level = self._levels.WARN if trouble else self._levels.OK
        status = self._status(f"fcslam: {robot}", robot, level, trouble or well, values)
        self._diagnose(DIAGNOSTICS_TOPIC, stamp_ns, [status])

    def _status(self, name: str, hardware: str, level: int, message: str, values: Mapping[str, object]) -> Any:
        make = self._codec.make
        pairs = [make("diagnostic_msgs/KeyValue", key=key, value=str(value)) for key, value in values.items()]
        return make(STATUS, level=level, name=name, message=message, hardware_id=hardware, values=pairs)

    def _diagnose(self, topic: str, stamp_ns: int, statuses: Sequence[Any], quality: Quality = STREAMED) -> None:
        header = self._codec.header(stamp_ns, "")
        self._send(topic, DIAGNOSTICS, self._codec.make(DIAGNOSTICS, header=header, status=statuses), quality)

    def _publisher(self, topic: str, kind: str, quality: Quality) -> Publish:
        with self._lock:
            if topic not in self._publishers:
                self._publishers[topic] = self._network.publisher(resolved(self._namespace, topic), kind, quality)
            return self._publishers[topic]

    def _send(self, topic: str, kind: str, message: Any, quality: Quality = STREAMED) -> None:
        """Publish a message; the first one on a topic begins it."""
        self._publisher(topic, kind, quality)(self._codec.encode(message, kind))

    def _marker(
        self,
        stamp_ns: int,
        name: str,
        kind: int,
        scale_m: float,
        colour: tuple[float, float, float],
        points: FloatArray,
    ) -> Any:
        """A marker of points (..., 2), metres in ``map``."""
        make, vector = self._codec.make, self._codec.vector
        r, g, b = colour
        width_m = 0.0 if kind == self._shapes.LINE_LIST else scale_m
        return make(
            MARKER,
            header=self._codec.header(stamp_ns, self._map_frame),
            ns=name,
            type=kind,
            pose=self._codec.pose(in_space(np.zeros(3))),
            scale=vector("Vector3", scale_m, width_m, width_m),
            color=make("std_msgs/ColorRGBA", r=r, g=g, b=b, a=0.8),
            points=[vector("Point", x, y) for x, y in points.reshape(-1, 2).tolist()],
        )

    def _posed(self, stamp_ns: int, T_map_base: FloatArray) -> Any:
        header = self._codec.header(stamp_ns, self._map_frame)
        return self._codec.make(POSE_STAMPED, header=header, pose=self._codec.pose(in_space(T_map_base)))


def _is_same(before: OccupancyMap, after: OccupancyMap) -> bool:
    is_in_place = (before.resolution_m, before.origin_xy) == (after.resolution_m, after.origin_xy)
    return is_in_place and np.array_equal(before.cells, after.cells)


def _pose_topic(robot: str) -> str:
    """The topic of a robot's poses; ROS allows letters, digits and underscores in its name, and no digit first."""
    name = "".join(one if one.isascii() and one.isalnum() else "_" for one in robot)
    return f"fleet/{'_' * name[:1].isdigit()}{name}/pose"


def nanoseconds(stamp: float) -> int:
    """A stamp in seconds as ROS counts, not below 0."""
    return max(0, round(stamp * 1e9))


def _steps(poses: FloatArray) -> Sequence[int]:
    length_m = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    step_m = max(PATH_STEP_M, length_m / LONGEST_PATH)
    kept: list[int] = []
    places = poses[:, :2].tolist()
    for at, (x, y) in enumerate(places):
        if not kept or hypot(x - places[kept[-1]][0], y - places[kept[-1]][1]) >= step_m:
            kept.append(at)
    if kept and kept[-1] != len(poses) - 1:
        kept.append(len(poses) - 1)
    return kept
