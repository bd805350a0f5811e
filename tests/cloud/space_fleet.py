"""Robots in space: drives through drawn flats, whose walls get a height and whose bases lean."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from fcslam.geometry import se2, se3
from fcslam.geometry.voxels import to_steps, voxelised
from fcslam.lidar.scan import keyscan_points
from fcslam.records import Constraint, FloatArray, Keyscan, LaserModel, Place, VoxelMap, frozen
from fcslam.wire.messages import Hello, Packet
from tests.flats import BACK, ROUND, Drive, flat
from tests.small_fleet import driven, in_order

SCANNER_M = 0.6
HEIGHTS_M = np.arange(0.05, 2.05, 0.1)
BASE_M = 0.25
"""Height of the leaning bases over the floor."""


@lru_cache
def planar(name: str, seed: int) -> tuple[Packet, ...]:
    """What a robot with a 2D LiDAR sends of its drive through the flat."""
    drive = Drive(name, ROUND if name == "a" else BACK, flat(), seed)
    return tuple(driven(drive.records(), name=name)[1])


def leaning(pitch_rad: float) -> FloatArray:
    """T_ground_base of a base that leans."""
    T: FloatArray = se3.exp((0.0, 0.0, 0.0, 0.0, pitch_rad, 0.0))
    T[2] = BASE_M
    return T


def in_space(packets: Sequence[Packet], T_ground_base: FloatArray, extra: FloatArray | None = None) -> list[Packet]:
    """The same drive by a robot with a 3D LiDAR, with a voxel map before each place.

    ``extra``: points (N, 3) beside each place, in its ``ground``.
    """
    lasers: tuple[LaserModel, ...] = ()
    keyscans, chain, sent = list[Keyscan](), [np.zeros(3)], list[tuple[float, object]]()
    moved = np.linalg.inv(se3.adjoint(se3.inverse(T_ground_base)))
    for packet in packets:
        body = packet.body
        if isinstance(body, Hello):
            lasers = body.lasers
        elif isinstance(body, Keyscan):
            keyscans.append(body)
        elif isinstance(body, Constraint):
            if body.j == body.i + 1:
                chain.append(se2.compose(chain[-1], body.T_i_j))
            information = np.diag([0.0, 0.0, 1e4, 1e5, 1e5, 0.0])
            information[np.ix_((0, 1, 5), (0, 1, 5))] = body.information
            T_i_j = se3.compose(se3.inverse(T_ground_base), se3.compose(se3.from_plane(body.T_i_j), T_ground_base))
            turned = moved.T @ information @ moved
            body = Constraint(body.robot, body.i, body.j, body.kind, frozen(T_i_j), frozen(0.5 * (turned + turned.T)))
        elif isinstance(body, Place):
            sent.append((packet.time, voxel_map(body, keyscans, np.array(chain), lasers, T_ground_base, extra)))
        sent.append((packet.time, body))
    robot = packets[0].robot
    return [Packet(robot, 0, n, time, body) for n, (time, body) in enumerate(sent)]  # type: ignore[arg-type]


def voxel_map(
    place: Place,
    keyscans: Sequence[Keyscan],
    chain: FloatArray,
    lasers: Sequence[LaserModel],
    T_ground_base: FloatArray,
    extra: FloatArray | None,
) -> VoxelMap:
    """Walls from the scans of a place, as high as a man, and the floor along its way."""
    poses = se2.between(chain[place.id.number], chain[place.first : place.last + 1])
    points, scans = [], []
    for n, (pose, keyscan) in enumerate(zip(poses, keyscans[place.first : place.last + 1], strict=True)):
        walls = se2.transform(pose, keyscan_points(keyscan, lasers).points)
        floor = (pose[:2] + 0.5 * (walls - pose[:2]))[::4]
        points += [np.column_stack((walls, np.full(len(walls), z))) for z in HEIGHTS_M]
        points += [np.column_stack((floor, np.zeros(len(floor))))]
        scans += [np.full(len(walls) * len(HEIGHTS_M) + len(floor), n)]
    origins = np.column_stack((poses[:, :2], np.full(len(poses), SCANNER_M)))
    if extra is not None:
        points.append(extra)
        scans.append(np.full(len(extra), place.id.number - place.first))
    steps, seen_from = voxelised(np.concatenate(points), np.concatenate(scans), origins)
    T_base_ground = frozen(se3.inverse(T_ground_base))
    made = frozen(steps, np.int16), frozen(to_steps(origins), np.int16), frozen(seen_from, np.uint8)
    return VoxelMap(place.id, place.first, place.last, T_base_ground, *made)


GROUND = {"a": leaning(0.08), "b": leaning(-0.05)}


def sent(*robots: str, extra: FloatArray | None = None) -> list[Packet]:
    """Packets of robots: in capitals those with a 2D LiDAR."""
    packets: list[Packet] = []
    for name in robots:
        plane = planar(name.lower(), ord(name.lower()))
        packets += plane if name.isupper() else in_space(plane, GROUND[name], extra if name == "b" else None)
    return in_order(packets)
