"""The joint maps of a mission as robots get them: their grids, and the newest pose of each robot.

The worker draws them beside itself and writes them as one file. The service cuts them into tiles.
"""

import io
import json
import math
import threading
import time
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fcslam.cloud.report import fused_maps
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import robot_and_epoch
from fcslam.errors import StoreError
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.exploration import Explorer
from fcslam.maps.frontiers import Frontier, frontiers
from fcslam.maps.joint_tiles import TileBatch, TileHistory, frame_of
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.metrics.trajectory import LARGEST_SPEED_M_S
from fcslam.runs.folder import identity
from fcslam.storage.files import write_file

ASSIGN_EVERY_S = 5.0
"""Least time between two assignments of frontiers."""
ASSIGN_SHARE = 0.1
"""Share of the time that assignments take of one core, at most."""
ACTIVE_S = 60.0
"""A robot that was not heard for longer explores nothing, if another one was."""
MOST_EXPLORERS = 32
"""Robots of one map that get frontiers; the others get none."""
MOST_FRONTIERS = 50
"""Frontiers of one map; those with the least gain are left out."""


@dataclass(frozen=True, slots=True)
class JointSession:
    """The newest session of a robot in the joint maps."""

    robot: str
    epoch: int
    map: int
    floor: str
    pose: tuple[float, float, float]
    """``T_map_base`` of its newest keyscan."""
    stamp: float
    """Stamp of that keyscan, seconds."""
    heard_s: float
    """When that took effect, seconds since 1970; 0: not known."""


@dataclass(frozen=True, slots=True, eq=False)
class JointMaps:
    """The joint maps of one moment."""

    sessions: Sequence[JointSession]
    """One for each robot: its newest session."""
    grids: Mapping[int, OccupancyMap]
    frames: Mapping[int, str]
    """By number of the map, as the grids."""
    robot_radius_m: float = 0.0


def joint_maps_of(result: FleetResult, heard_s: Mapping[tuple[str, int], float], config: OccupancyConfig) -> JointMaps:
    """Draw the joint maps of an estimate; ``heard_s``: when the newest packet of each session took effect."""
    newest: dict[str, JointSession] = {}
    anchors: dict[int, str] = {}
    grids = dict(fused_maps(result, config))
    for mapped in result.robots:
        robot, epoch = robot_and_epoch(mapped.robot)
        if mapped.map_index in grids and mapped.map_index not in anchors:
            resolution_m = grids[mapped.map_index].resolution_m
            anchors[mapped.map_index] = frame_of(mapped.T_map_base[0].tolist(), mapped.robot, resolution_m)
        if robot not in newest or epoch > newest[robot].epoch:
            x, y, theta = mapped.T_map_base[-1].tolist()
            newest[robot] = JointSession(
                robot,
                epoch,
                mapped.map_index,
                mapped.floor,
                (x, y, theta),
                float(mapped.stamps[-1]),
                heard_s.get((robot, epoch), 0.0),
            )
    return JointMaps(list(newest.values()), grids, anchors, config.robot_radius_m)


def write_joint_maps(path: Path, maps: JointMaps) -> None:
    """Write the joint maps as one file of NumPy arrays, whole or not at all; what is no grid is JSON in one of them."""
    about = {
        k: {"resolution": grid.resolution_m, "origin": grid.origin_xy, "frame": maps.frames[k]}
        for k, grid in maps.grids.items()
    }
    head = {"sessions": [asdict(one) for one in maps.sessions], "maps": about, "radius": maps.robot_radius_m}
    arrays: dict[str, Any] = {str(k): grid.cells for k, grid in maps.grids.items()}
    arrays["head"], content = np.frombuffer(json.dumps(head).encode(), np.uint8), io.BytesIO()
    np.savez_compressed(content, **arrays)
    write_file(path, content.getvalue())


def read_joint_maps(path: Path) -> JointMaps:
    """Read what ``write_joint_maps`` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            head = json.loads(file["head"].tobytes())
            maps = {int(k): about for k, about in head["maps"].items()}
            grids = {
                k: OccupancyMap(file[str(k)], about["resolution"], tuple(about["origin"])) for k, about in maps.items()
            }
        sessions = [JointSession(**{**one, "pose": tuple(one["pose"])}) for one in head["sessions"]]
        frames = {k: about["frame"] for k, about in maps.items()}
        return JointMaps(sessions, grids, frames, float(head["radius"]))
    except (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile) as error:
        raise StoreError(f"{path}: no joint maps can be read ({error})") from error


Exploration = tuple[tuple[str, ...], Sequence[Frontier], Mapping[str, Frontier]]
"""The robots whose distances the frontiers of one map have; the frontiers; and each robot's, if it can reach one."""


class ServedJointMaps:
    """The joint maps of a mission for its robots: tiles that changed, and live poses. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._identity: tuple[int, int] | None = None
        self._maps = JointMaps((), {}, {})
        self._histories: dict[str, TileHistory] = {}
        """By frame."""
        self._live: dict[str, tuple[int, tuple[float, float, float], float]] = {}
        """By robot, the map and the pose that it says it has, and when it said so, seconds since 1970."""
        self._exploring = threading.Lock()
        self._explorers: dict[str, Explorer] = {}
        """By frame."""
        self._explorations: tuple[float, float, dict[str, Exploration]] = -math.inf, -math.inf, {}
        """When they were made, until when they count, and by frame: a map may change its number, or its frame."""

    def follow(self, path: Path) -> JointMaps:
        """The joint maps in a file as they are now; those without content before there is one."""
        with self._lock:
            if path.exists() and (known := identity(path)) != self._identity:
                maps = read_joint_maps(path)
                histories = {frame: self._histories.get(frame, TileHistory()) for frame in maps.frames.values()}
                for k, frame in maps.frames.items():
                    histories[frame].update(frame, maps.grids[k])
                self._identity, self._maps, self._histories = known, maps, histories
            return self._maps

    def since(self, maps: JointMaps, number: int, frame: str, version: int, limit_bytes: int) -> TileBatch | None:
        """The changed tiles of a map, as ``TileHistory.since``; None if there is no such map."""
        with self._lock:
            history = self._histories.get(maps.frames.get(number, ""))
            return None if history is None else history.since(frame, version, limit_bytes)

    def say(self, robot: str, number: int, pose: tuple[float, float, float], now_s: float) -> None:
        """Take the map and the pose that a robot of the newest joint maps says it has now."""
        with self._lock:
            if any(session.robot == robot for session in self._maps.sessions):
                self._live[robot] = number, pose, now_s

    def pose(self, session: JointSession) -> tuple[tuple[float, float, float], float]:
        """The newest credible pose of a robot and when it was there, seconds since 1970.

        What a robot says counts only if it can have driven there since its newest keyscan, which the map confirms.
        """
        number, pose, said_s = self._live.get(session.robot, (-1, session.pose, 0.0))
        if number == session.map and 0.0 < session.heard_s <= said_s:
            reach_m = 1.0 + LARGEST_SPEED_M_S * (said_s - session.heard_s)
            if math.dist(pose[:2], session.pose[:2]) <= reach_m:
                return pose, said_s
        return session.pose, session.heard_s

    def explorations(self, maps: JointMaps, now_s: float) -> dict[int, Exploration]:
        """The frontiers of each map, about ``ASSIGN_EVERY_S`` old at most; of large maps older. None before the first.

        ``now_s``: seconds since 1970.
        """
        made_s, until_s, found = self._explorations
        is_fresh = made_s <= now_s < until_s and found.keys() == set(maps.frames.values())
        # While one request makes them, others get the ones before, and hold no thread.
        if not is_fresh and self._exploring.acquire(blocking=False):
            try:
                began_s = time.perf_counter()
                self._explorers = {frame: self._explorers.get(frame, Explorer()) for frame in maps.frames.values()}
                found = {frame: self._explored(maps, number, now_s) for number, frame in maps.frames.items()}
                spent_s = time.perf_counter() - began_s
                self._explorations = now_s, now_s + max(ASSIGN_EVERY_S, spent_s / ASSIGN_SHARE), found
            finally:
                self._exploring.release()
        return {number: found[frame] for number, frame in maps.frames.items() if frame in found}

    def _explored(self, maps: JointMaps, number: int, now_s: float) -> Exploration:
        poses = {one.robot: self.pose(one) for one in maps.sessions if one.map == number}
        active = {robot: pose for robot, pose in poses.items() if now_s - pose[1] <= ACTIVE_S} or poses
        at = {robot: (pose[0][0], pose[0][1]) for robot, pose in sorted(active.items())[:MOST_EXPLORERS]}
        found = frontiers(maps.grids[number], np.array(list(at.values())).reshape(-1, 2), maps.robot_radius_m)
        found = found[:MOST_FRONTIERS]
        return tuple(at), found, self._explorers[maps.frames[number]].assign(found, at)
