"""One packet of every kind, written down; ``python -m wire.examples`` (from tests/) writes the golden files again."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fcslam.records import (
    Beams,
    Channel,
    Constraint,
    ConstraintKind,
    Correction,
    DetectorFile,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    Place,
    Sweep,
    Tag,
    TagFamily,
    TagSighting,
    VoxelMap,
    frozen,
)
from fcslam.wire.messages import Acknowledgement, Body, DetectorUpdate, Hello, Packet
from fcslam.wire.packets import encode
from fcslam.wire.quantisation import dequantise

GOLDEN = Path(__file__).parent / "golden"

HELLO = Hello(
    "alice",
    7,
    (
        LaserModel(181, -1.5, 0.0166015625, 81.25, (0.125, -0.25, 0.5)),
        LaserModel(360, -3.125, 0.0166015625, 12.0, (-0.25, 0.0, 3.125)),
    ),
    {Channel.LIDAR: "orb-1", Channel.CAMERA: "cnn-0.3+r12"},
)
FLOOR_HELLO = replace(HELLO, floor="-1")
KEYSCAN = Keyscan(
    KeyscanId("alice", 12),
    1042.25,
    dequantise(np.array([0, 1, 500, 501, 501, 499, 65535, 0, 0, 1000, 999, 998, 997, 996], np.uint16)),
)
VARIED_KEYSCAN = replace(KEYSCAN, laser=1, beams=Beams(14, -1.25, 0.0078125))
SWEPT_KEYSCAN = replace(KEYSCAN, sweep=Sweep(0.0, 0.14, (0.512, -0.003, 1.25), (0.25, 0.0, -3.5)).rounded())
ODOMETRY = Constraint(
    "alice",
    11,
    12,
    ConstraintKind.ODOMETRY,
    frozen([0.5, -0.03125, 0.25]),
    frozen([[2500.0, 16.0, -8.0], [16.0, 1600.0, 4.0], [-8.0, 4.0, 10000.0]]),
)
CLOSURE = Constraint(
    "alice", 3, 12, ConstraintKind.CLOSURE, frozen([-1.5, 2.0, -3.125]), frozen(np.diag([100.0, 1.0, 400.0]))
)
LIDAR_PLACE = Place(
    KeyscanId("alice", 12),
    Channel.LIDAR,
    "orb-1",
    2,
    12,
    frozen([[-327.67, 327.67], [0.0, 0.0], [1.25, -3.5]], np.float32),
    frozen(np.arange(96).reshape(3, 32), np.uint8),
)
CAMERA_PLACE = Place(
    KeyscanId("alice", 12),
    Channel.CAMERA,
    "cnn-0.3+r12",
    12,
    12,
    frozen([[2.5, -1.25, 0.75], [3.0, 0.0, 1.5]], np.float32),
    frozen(np.arange(64).reshape(2, 32), np.uint8),
)
TAG_SIGHTING = TagSighting(
    KeyscanId("alice", 12),
    Tag(TagFamily.APRILTAG_36H11, 586),
    frozen([1.5, -0.25, 3.0]),
    frozen([[400.0, 16.0, -8.0], [16.0, 900.0, 4.0], [-8.0, 4.0, 100.0]]),
)
KEYSCAN_FIX = KeyscanFix(KeyscanId("alice", 12), 47.3769, 8.5417, 408.0, 1.5, (-0.25, 0.5))
SPACE_ODOMETRY = Constraint(
    "alice",
    11,
    12,
    ConstraintKind.ODOMETRY,
    frozen([0.5, -0.03125, 0.125, 0.5, -0.5, 0.5, 0.5]),
    frozen(np.diag([2500.0, 1600.0, 900.0, 1e4, 1e4, 1e4]) + np.outer(*2 * (np.arange(6.0),))),
)
VOXEL_MAP = VoxelMap(
    KeyscanId("alice", 12),
    2,
    12,
    frozen([0.0, 0.0, -0.125, 0.5, 0.5, -0.5, 0.5]),
    frozen([[-640, -640, -320], [-3, 4, 5], [-1, 4, 10], [0, 0, 0], [639, 639, 959]], np.int16),
    frozen([[0, 0, 30], [-25, 3, 31]], np.int16),
    frozen([1, 0, 0, 1, 0], np.uint8),
)
SPACE_CORRECTION = Correction("alice", 5, 0, frozen([10.5, -20.25, 3.125, 0.5, 0.5, -0.5, 0.5]), 0.5)
CORRECTION = Correction("alice", 4, 0, frozen([10.5, -20.25, 3.125]), 0.75)
ACKNOWLEDGEMENT = Acknowledgement("alice", 7, 41)
DETECTOR_UPDATE = DetectorUpdate(
    "alice", DetectorFile(Channel.CAMERA, "light-0a1b2c3d4e5f", 1, 1588335, bytes(range(32)))
)


def packet(body: Body) -> Packet:
    return Packet("alice", 7, 42, 1042.5, body)


EXAMPLES = {
    "hello": packet(HELLO),
    "floor_hello": packet(FLOOR_HELLO),
    "keyscan": packet(KEYSCAN),
    "varied_keyscan": packet(VARIED_KEYSCAN),
    "swept_keyscan": packet(SWEPT_KEYSCAN),
    "odometry": packet(ODOMETRY),
    "closure": packet(CLOSURE),
    "lidar_place": packet(LIDAR_PLACE),
    "camera_place": packet(CAMERA_PLACE),
    "tag_sighting": packet(TAG_SIGHTING),
    "keyscan_fix": packet(KEYSCAN_FIX),
    "space_odometry": packet(SPACE_ODOMETRY),
    "voxel_map": packet(VOXEL_MAP),
    "space_correction": packet(SPACE_CORRECTION),
    "correction": packet(CORRECTION),
    "acknowledgement": packet(ACKNOWLEDGEMENT),
    "detector_update": packet(DETECTOR_UPDATE),
}


def same(a: Any, b: Any) -> bool:
    """Equality of records, arrays included: shapes, types and every number."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    return bool(a == b)


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for name, example in EXAMPLES.items():
        (GOLDEN / f"{name}.bin").write_bytes(encode(example))
