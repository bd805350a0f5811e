"""A fleet's result as a run: trajectories, closures, maps and metrics."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.placement import region_files, with_regions
from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.cloud.sessions import robot_of
from fcslam.geometry.groups import SE2, group_of
from fcslam.graph.evidence import ClusterEvidence
from fcslam.graph.g2o import g2o_text
from fcslam.graph.pose_graph import PoseGraph
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.drawing import picture
from fcslam.maps.fusion import fuse
from fcslam.maps.joint_voxels import ply_of
from fcslam.maps.occupancy_map import OccupancyMap, map_stem, map_yaml, pgm_bytes, server_files
from fcslam.processes import trim_memory
from fcslam.records import PLACE_CHANNELS, ClosureStatus, FloatArray, LoopClosure, VoxelMap, frozen
from fcslam.runs import ClosureRow, Join, LocalMap, Metric, RobotTrajectory, Run
from fcslam.wire.ledger import Ledger, Traffic
from fcslam.wire.messages import PacketKind

TURNS = "turns"
"""The metric of a service's run: how many packets had taken effect."""
LEAST_DRAWN = 10
"""Keyscans, 2.5 m of path, of a map besides the largest one that gets a picture. Sessions that ended at once need none,
and a picture takes longer than all else about them."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A robot's scans, each with a fixed offset to a keyscan."""

    stamps: FloatArray
    """Shape (N,)."""
    keyscans: NDArray[np.int64]
    """Number of each scan's keyscan, shape (N,)."""
    T_keyscan_base: FloatArray
    """Pose of each scan in its keyscan's base, shape (N, 3), or (N, 7) of a robot in space."""

    def on_keyscans(self, T_keyscans: FloatArray) -> FloatArray:
        """Poses (N, P) of all scans, given the poses (K, P) of the keyscans."""
        group, offsets = group_of(T_keyscans), self.T_keyscan_base
        if group is SE2:
            offsets = group_of(offsets).to_plane(offsets)
        elif group_of(offsets) is SE2:
            offsets = group.from_plane(offsets)
        return group.compose(T_keyscans[self.keyscans], offsets)


def keyscan_track(robot: MappedRobot) -> Track:
    """The track that the cloud knows: the keyscans, without the scans between them."""
    count = len(robot.stamps)
    return Track(robot.stamps, np.arange(count), np.zeros((count, 3)))


def run_of(
    result: FleetResult,
    tracks: Mapping[str, Track],
    metrics: Sequence[Metric],
    config_yaml: str,
    grid: OccupancyConfig,
    *,
    with_local_maps: bool = True,
    with_certificates: bool = True,
    measured: PoseGraph | None = None,
) -> Run:
    """Collect the contents of a run folder; ``tracks`` holds every robot of the result and gives their order.

    ``measured`` is the graph before anchors bent it.
    """
    mapped = {robot.robot: robot for robot in result.robots}
    trajectories = {
        name: RobotTrajectory(
            name,
            mapped[name].map_index,
            frozen(track.stamps),
            frozen(track.on_keyscans(mapped[name].T_map_base)),
            mapped[name].floor,
            None if (space := mapped[name].space) is None else frozen(track.on_keyscans(space.T_map_base)),
        )
        for name, track in tracks.items()
    }
    fused = dict(fused_maps(result, grid))
    certificates = _certificates(result, fused, grid.robot_radius_m, measured) if with_certificates else {}
    trim_memory()  # dense covariances and pictures are large, and need not be there at the same time
    map_files = _map_files(result, trajectories, fused) | _space_files(result)
    trim_memory()
    if with_local_maps and 0 in certificates:  # a live run has it by turns
        metrics = [*metrics, Metric("map_error_95", certificates[0]["error_95"], "m")]
    return Run(
        trajectories=trajectories,
        closures=tuple(_closure_row(closure, mapped) for closure in result.closures),
        joins=tuple(_join(pair, evidence) for pair, evidence in result.joins.items()),
        metrics={metric.name: metric for metric in (*_counts(result), *metrics)},
        config_yaml=config_yaml,
        pose_graph_g2o=g2o_text(result.space_graph or result.graph, _ids([mapped[name] for name in sorted(tracks)])),
        map_files=map_files,
        local_maps={
            name: _local_map(mapped[name], track, grid, _map_alone(mapped[name], result, fused))
            for name, track in tracks.items()
            if with_local_maps
        },
        quality=json.dumps(certificates, separators=(",", ":"), allow_nan=False).encode() if certificates else b"",
    )


def _join(pair: frozenset[str], evidence: ClusterEvidence) -> Join:
    robot_i, robot_j = sorted(pair)
    counts, fit = (evidence.closures, evidence.separate_places), evidence.fit
    if fit is None or not fit.is_compared:
        return Join(robot_i, robot_j, *counts, math.nan, math.nan, math.nan, math.nan)
    elsewhere = max(0.0, fit.rival_support / fit.support) if fit.support > 0.0 else 0.0
    return Join(robot_i, robot_j, *counts, fit.seen_m, fit.contradiction * fit.seen_m, fit.likeness, elsewhere)


def traffic_metrics(ledger: Ledger, tracks: Mapping[str, Track]) -> list[Metric]:
    """Packets and bytes by kind of message and channel of places, of the whole fleet; and by robot up and down.

    Rates are over the time that a robot recorded, in all sessions. A ledger of one direction says nothing of the other.
    """
    traffic = {str(kind): ledger.total(kind=kind) for kind in sorted({label.kind for label in ledger.accepted})}
    traffic |= {f"{channel}_{PacketKind.PLACE}": ledger.total(channel=channel) for channel in PLACE_CHANNELS}
    robots = sorted({label.robot for label in ledger.accepted})
    return [
        *(Metric(f"{name}_packets", total.count, "1") for name, total in traffic.items()),
        *(Metric(f"{name}_bytes", total.bytes, "B") for name, total in traffic.items()),
        *_link_metrics("uplink", {robot: ledger.uplink(robot) for robot in robots}, tracks),
        *_link_metrics("downlink", {robot: ledger.downlink(robot) for robot in robots}, tracks),
    ]


def _link_metrics(link: str, traffic: Mapping[str, Traffic], tracks: Mapping[str, Track]) -> list[Metric]:
    if not any(total.count for total in traffic.values()):
        return []
    recorded_s = dict.fromkeys(traffic, 0.0)
    for session, track in tracks.items():
        robot = robot_of(session)
        recorded_s[robot] = recorded_s.get(robot, 0.0) + (float(np.ptp(track.stamps)) if len(track.stamps) else 0.0)
    rates = {robot: total.bytes / 1e3 / recorded_s[robot] for robot, total in traffic.items() if recorded_s[robot] > 0}
    return [
        *(Metric(f"{link}_bytes_{robot}", total.bytes, "B") for robot, total in traffic.items()),
        *(Metric(f"{link}_rate_{robot}", rates.get(robot, math.nan), "kB/s") for robot in traffic),
    ]


def _map_alone(robot: MappedRobot, result: FleetResult, maps: Mapping[int, OccupancyMap]) -> OccupancyMap | None:
    """The map of a robot that is alone in it, as it made it."""
    indices = [*(other.map_index for other in result.robots), *(region.map_index for region in result.regions)]
    is_own = indices.count(robot.map_index) == 1 and np.array_equal(robot.T_map_base, robot.T_local_base)
    return maps[robot.map_index] if is_own else None


def _local_map(robot: MappedRobot, track: Track, grid: OccupancyConfig, fused: OccupancyMap | None) -> LocalMap:
    if fused is None:
        fused = fuse(robot.keyscans, robot.T_local_base[robot.numbers()], {robot.robot: robot.lasers}, grid)
    name = f"{robot.robot}.pgm"
    return LocalMap(
        robot.robot,
        frozen(track.stamps),
        frozen(track.on_keyscans(robot.T_local_base)),
        pgm_bytes(fused),
        map_yaml(fused, name),
    )


def _ids(robots: Sequence[MappedRobot]) -> list[int]:
    """Id of each variable of the pose graph: robot by robot along its path, with one unused id between two robots.

    Readers of g2o take an edge between consecutive ids for odometry.
    """
    ids, first = [0] * sum(len(robot.variables) for robot in robots), 0
    for robot in robots:
        for number, variable in enumerate(robot.variables.tolist(), start=first):
            ids[variable] = number
        first += len(robot.variables) + 1
    return ids


def _closure_row(closure: LoopClosure, mapped: dict[str, MappedRobot]) -> ClosureRow:
    i, j = closure.i, closure.j
    return ClosureRow(
        i.robot,
        float(mapped[i.robot].stamps[i.number]),
        j.robot,
        float(mapped[j.robot].stamps[j.number]),
        closure.channel,
        closure.similarity,
        group_of(closure.T_i_j).to_plane(closure.T_i_j),
        closure.status,
        closure.reason,
    )


def _map_files(
    result: FleetResult, trajectories: Mapping[str, RobotTrajectory], maps: Mapping[int, OccupancyMap]
) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    for k, fused in maps.items():
        stem = map_stem(k)
        keyscans = {robot.robot: robot.T_map_base for robot in result.robots if robot.map_index == k}
        regions = [region for region in result.regions if region.map_index == k]
        files |= server_files(stem, fused) | region_files(fused, stem, regions)
        if k == 0 or sum(map(len, keyscans.values())) >= LEAST_DRAWN:
            ways = {name: robot.T_map_base for name, robot in trajectories.items() if name in keyscans}
            files[f"{stem}.png"] = picture(fused, ways, result.closures, keyscans)
    return files


def _space_files(result: FleetResult) -> dict[str, bytes]:
    """The voxel maps of robots in space, by map."""
    by_map: dict[int, list[tuple[VoxelMap, FloatArray]]] = {}
    for robot in result.robots:
        if robot.space is not None:
            placed = ((voxels, robot.space.T_map_base[voxels.id.number]) for voxels in robot.space.voxel_maps)
            by_map.setdefault(robot.map_index, []).extend(placed)
    return {f"{map_stem(k)}.ply": ply_of(placed) for k, placed in by_map.items() if placed}


def _certificates(
    result: FleetResult, maps: Mapping[int, OccupancyMap], robot_radius_m: float, measured: PoseGraph | None
) -> dict[int, dict[str, Any]]:
    from fcslam.maps.certificate import MappedPath, certify  # a live robot has no use for it, and SciPy is large

    certificates = {}
    for k, fused in maps.items():
        members = [robot for robot in result.robots if robot.map_index == k and len(robot.stamps)]
        if members and fused.cells.any() and (k == 0 or sum(len(robot.stamps) for robot in members) >= LEAST_DRAWN):
            paths = [MappedPath(robot.T_map_base, robot.variables) for robot in members]
            certificates[k] = certify(result.graph, paths, fused, None, robot_radius_m, result.space_graph or measured)
    return certificates


def fused_maps(result: FleetResult, grid: OccupancyConfig) -> Iterator[tuple[int, OccupancyMap]]:
    """Number and grid of each map of a result, without the regions that users erased."""
    for k in sorted({robot.map_index for robot in result.robots}):
        fused = fuse_members([robot for robot in result.robots if robot.map_index == k], grid)
        yield k, with_regions(fused, [region for region in result.regions if region.map_index == k])


def fuse_members(members: Sequence[MappedRobot], grid: OccupancyConfig) -> OccupancyMap:
    """One map of robots that share it."""
    keyscans = [keyscan for robot in members for keyscan in robot.keyscans]
    poses: FloatArray = np.concatenate([robot.T_map_base[robot.numbers()] for robot in members])
    senders = {robot.robot: robot_of(robot.robot) for robot in members}
    return fuse(keyscans, poses, {robot.robot: robot.lasers for robot in members}, grid, senders)


def _counts(result: FleetResult) -> list[Metric]:
    between = [c.status for c in result.closures if c.i.robot != c.j.robot]
    within = [c.status for c in result.closures if c.i.robot == c.j.robot]
    return [
        Metric("robots", len(result.robots), "1"),
        Metric("maps", len({robot.map_index for robot in result.robots}), "1"),
        Metric("keyscans", sum(len(robot.stamps) for robot in result.robots), "1"),
        Metric("intra_robot_closures_accepted", within.count(ClosureStatus.ACCEPTED), "1"),
        Metric("intra_robot_closures_revoked", within.count(ClosureStatus.REVOKED), "1"),
        *(Metric(f"inter_robot_closures_{status}", between.count(status), "1") for status in ClosureStatus),
    ]
