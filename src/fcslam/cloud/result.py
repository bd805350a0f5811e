"""What a fleet's packets say in the end: every closure decided, every robot placed."""

from dataclasses import dataclass

from fcslam.cloud.joining import judge
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.ledger import ClosureLedger
from fcslam.cloud.robots import RobotStore
from fcslam.graph.consistency import ConsistencySettings
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import ClosureStatus, Correction, FloatArray, Keyscan, LaserModel, LoopClosure, frozen

HOLDS = 0.5
"""Graduated non-convexity ends at weight 1 (the closure holds) or 0."""


@dataclass(frozen=True, slots=True)
class MappedRobot:
    """One robot in the result."""

    robot: str
    map_index: int
    """0 is the map of most robots."""
    keyscans: tuple[Keyscan, ...]
    T_map_base: FloatArray
    """Of each keyscan, in the frame of its map, shape (N, 3)."""
    laser: LaserModel


@dataclass(frozen=True, slots=True)
class FleetResult:
    """Poses, closures with their verdicts, corrections, and the graph behind them."""

    robots: tuple[MappedRobot, ...]
    closures: tuple[LoopClosure, ...]
    """Between robots and within them."""
    corrections: tuple[Correction, ...]
    graph: PoseGraph
    """All keyscans at their optimised poses, with the constraints that hold."""


def conclude(
    store: RobotStore, graph: JointGraph, ledger: ClosureLedger, settings: ConsistencySettings, version: int
) -> FleetResult:
    """Solve robustly, revoke what contradicts the rest, separate maps that only revoked closures held together."""
    if store.robots:
        graph.optimize_robustly()
    _decide(graph, ledger)
    if _revoke_contested(graph, ledger, settings):
        graph.optimize_robustly(ledger.revoked_edges())
        _decide(graph, ledger)
    maps = graph.maps(ledger.accepted_edges())
    index = {robot: k for k, robots in enumerate(maps) for robot in robots}
    robots = tuple(
        MappedRobot(robot, index[robot], store.keyscans(robot), frozen(graph.trajectory(robot)), store.laser(robot))
        for robot in store.robots
    )
    corrections = tuple(
        Correction(robot, version, index[robot], frozen(graph.T_map_odom(robot))) for robot in store.robots
    )
    closures = tuple(entry.closure for entry in ledger)
    return FleetResult(robots, closures, corrections, graph.optimized(ledger.revoked_edges()))


def _decide(graph: JointGraph, ledger: ClosureLedger) -> None:
    """Give every closure its last status and the reason for it."""
    for entry in ledger:
        status = entry.closure.status
        if status is ClosureStatus.ACCEPTED and entry.edge is not None and graph.weight(entry.edge) < HOLDS:
            entry.set(ClosureStatus.REVOKED, "contradicts the joint graph")
        elif status is ClosureStatus.VERIFIED:
            entry.set(ClosureStatus.REJECTED, entry.closure.reason or "outside the dominant cluster")


def _revoke_contested(graph: JointGraph, ledger: ClosureLedger, settings: ConsistencySettings) -> bool:
    """Revoke what joined two robots early if all evidence together would not; tells whether anything was revoked.

    The cluster that joins is dominant when it does. Closures that contradict it and come later are never accepted,
    so the robust solve does not see them.
    """
    contested = False
    for pair in ledger.joined():
        entries = ledger.between(*pair)
        verdict = judge(entries, pair, graph, settings)
        if verdict.contested:
            contested = True
            for entry in entries:
                if entry.closure.status is ClosureStatus.ACCEPTED:
                    entry.set(ClosureStatus.REVOKED, verdict.reason)
    return contested
