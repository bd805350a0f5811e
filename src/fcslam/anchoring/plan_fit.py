"""A map fitted to a floor plan: the scale of each robot's ranges, and poses that the walls of the plan correct."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fcslam.anchoring.plan import BuildingPlan
from fcslam.cloud.result import MappedRobot
from fcslam.geometry import se2
from fcslam.graph.anchored import PosePrior, optimize_anchored
from fcslam.graph.pose_graph import PoseGraph
from fcslam.lidar.field import CELL_M, EMPTY
from fcslam.lidar.matching import OPPOSED, match_scan
from fcslam.lidar.scan import PointScan, keyscan_points
from fcslam.lidar.submap import Submap, build_submap
from fcslam.records import FloatArray, Keyscan, frozen

WEAK_M, WEAK_RAD = 0.05, 0.02
"""Least standard deviations of a pose by the plan, which is no more precise, however many points agree."""
POINT_SIGMA_M: Final = 0.15
"""Standard deviation of a wall in the plan, per point of a scan: errors of a plan are the same for all its points."""
LEAST_EXPLAINED: Final = 0.3
"""Least share of a scan's points that lie on walls of the plan."""
FARTHEST_CHI2: Final = 11.3
"""A pose by the plan that is farther from the map's own is wrong: the 99 % quantile of three degrees of freedom."""
ROUNDS: Final = 4
"""Matching and solving alternate this often."""
LARGEST_SCALE: Final = 0.03
"""Largest difference of a robot's scale from 1 that is found."""
SIGNIFICANT: Final = 3.0
"""A scale counts if it differs from 1 by this many standard deviations, and by ``LEAST_SCALE``."""
LEAST_SCALE: Final = 1e-3
_WIDTHS_M: Final = (0.4, 0.3, 0.2, 0.15, 0.1, 0.1, 0.06, 0.06, 0.06, 0.06)
"""Scales of the robust loss in the steps that find the scale."""
_CORRELATED: Final = 20.0
"""Points of a wall whose errors are those of one point."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanFit:
    """The robots of one map in the plan."""

    robots: tuple[MappedRobot, ...]
    """With poses in the plan and ranges in its scale."""
    poses: FloatArray
    """Poses of the variables of their graph, shape (N, 3)."""
    graph: PoseGraph
    """The graph in their scale, at these poses."""
    scales: Mapping[str, float]
    """Scale of each robot's lengths."""


def map_submap(robots: Sequence[MappedRobot]) -> Submap:
    """The whole map of robots that share one."""
    scans = [
        (keyscan_points(keyscan, robot.lasers), robot.T_map_base[row])
        for robot in robots
        for keyscan, row in zip(robot.keyscans, robot.numbers().tolist(), strict=True)
    ]
    return build_submap(scans, np.inf)


def fit_to_plan(plan: BuildingPlan, robots: Sequence[MappedRobot], graph: PoseGraph, T_plan_map: FloatArray) -> PlanFit:
    """Fit a map to the plan, from an alignment.

    Args:
        plan: the floor plan.
        robots: the robots of one map; their variables are those of ``graph``.
        graph: the constraints of these robots alone.
        T_plan_map: where the map lies in the plan, shape (3,), metres and radians.
    """
    found = {robot.robot: _scale(plan, map_submap([robot]), T_plan_map) for robot in robots}
    middle = np.append(plan.submap.surface.points.mean(axis=0), 0.0)
    # A robot's poses grow about the middle of the plan; solving puts them right.
    scaled = [scaled_robot(robot, found[robot.robot]) for robot in robots]
    owner = np.zeros(len(graph), np.int64)
    for number, robot in enumerate(robots):
        owner[robot.variables] = number
    lengths = np.array([found[robot.robot] for robot in robots])[owner]
    edges = [
        replace(edge, T_i_j=edge.T_i_j * np.array([lengths[edge.i] ** 0.5 * lengths[edge.j] ** 0.5] * 2 + [1.0]))
        for edge in graph.edges
    ]
    poses = se2.compose(T_plan_map, graph.poses())
    poses[:, :2] = middle[:2] + (poses[:, :2] - middle[:2]) * lengths[:, None]
    graph = PoseGraph(poses, edges)
    scans = [
        (int(robot.variables[row]), keyscan_points(keyscan, robot.lasers).thinned(CELL_M))
        for robot in scaled
        for keyscan, row in zip(robot.keyscans, robot.numbers().tolist(), strict=True)
    ]
    for number in range(ROUNDS):
        priors = _priors(plan, scans, poses, wide_scale_m=0.4 if number == 0 else 0.2)
        if number:
            priors = [prior for prior in priors if prior.chi2(poses) < FARTHEST_CHI2]
        if not priors:
            break
        poses = optimize_anchored(graph, poses, priors)
    scaled = [replace(robot, T_map_base=frozen(poses[robot.variables])) for robot in scaled]
    return PlanFit(tuple(scaled), poses, PoseGraph(poses, list(graph.edges)), found)


def scaled_robot(robot: MappedRobot, scale: float) -> MappedRobot:
    """The robot with its ranges and its own map in another scale."""
    if scale == 1.0:
        return robot
    lengths = np.array((scale, scale, 1.0))
    return replace(
        robot,
        keyscans=tuple(_scaled_keyscan(keyscan, scale) for keyscan in robot.keyscans),
        lasers=tuple(replace(laser, max_range_m=laser.max_range_m * scale) for laser in robot.lasers),
        T_local_base=frozen(robot.T_local_base * lengths),
    )


def _scaled_keyscan(keyscan: Keyscan, scale: float) -> Keyscan:
    return replace(keyscan, ranges_m=frozen(keyscan.ranges_m * np.float32(scale), np.float32))


def _priors(
    plan: BuildingPlan, scans: Sequence[tuple[int, PointScan]], poses: FloatArray, wide_scale_m: float
) -> list[PosePrior]:
    """The poses of scans by the walls of the plan that they see."""
    priors = []
    for variable, scan in scans:
        found = match_scan(scan, plan.submap.field, poses[variable], np.zeros((3, 3)), wide_scale_m=wide_scale_m)
        if found.explained < LEAST_EXPLAINED:
            continue
        information = found.information * (0.03 / POINT_SIGMA_M) ** 2 + 1e-2 * np.eye(3)
        covariance = np.linalg.inv(information) + np.diag((WEAK_M**2, WEAK_M**2, WEAK_RAD**2))
        information = np.linalg.inv(covariance)
        priors.append(PosePrior(variable, found.T_field_base, 0.5 * (information + information.T)))
    return priors


def _scale(plan: BuildingPlan, own: Submap, T_plan_map: FloatArray) -> float:
    """The factor that brings a robot's lengths into the scale of the plan; 1 if it is not clearly another.

    Beside the scale and the motion, the steps find by how much the walls of the plan are drawn too thick or too thin:
    a plan of the middle lines of walls makes no building larger.
    """
    points, normals = se2.transform(T_plan_map, own.surface.points), own.surface.normals
    if not len(points):
        return 1.0
    middle, field = points.mean(axis=0), plan.submap.field
    motion, scale, thickness = np.zeros(3), 1.0, 0.0
    variance = np.inf
    for width_m in _WIDTHS_M:
        cos, sin = np.cos(motion[2] + T_plan_map[2]), np.sin(motion[2] + T_plan_map[2])
        arms = se2.transform(np.array([0.0, 0.0, motion[2]]), points - middle) * scale
        at = arms + middle + motion[:2]
        labels = field.nearest(at)
        facing = normals @ np.array([[cos, sin], [-sin, cos]])
        known = labels != EMPTY
        surfels, its = field.points[labels[known]], field.normals[labels[known]]
        apart, arms, facing = at[known] - surfels, arms[known], facing[known]
        same = np.einsum("na,na->n", its, facing) > -OPPOSED
        apart, arms, its = apart[same], arms[same], its[same]
        if len(apart) < 50:
            return 1.0
        across = np.einsum("na,na->n", its, apart)
        along2 = np.maximum(0.0, np.einsum("na,na->n", apart, apart) - across**2)
        off = across - thickness
        weight = (width_m**2 / (width_m**2 + off**2 + 0.25 * along2)) ** 2
        J = np.column_stack((
            its, its[:, 1] * arms[:, 0] - its[:, 0] * arms[:, 1], np.einsum("na,na->n", its, arms), -np.ones(len(its))
        ))  # fmt: skip
        H = J.T @ (weight[:, None] * J) + 1e-6 * np.eye(5)
        step = -np.linalg.solve(H, J.T @ (weight * off))
        motion, scale, thickness = motion + step[:3], scale * (1.0 + step[3]), thickness + step[4]
        variance = _CORRELATED * float((weight * off**2).sum() / weight.sum()) * float(np.linalg.inv(H)[3, 3])
    changed = abs(scale - 1.0)
    clear = changed > max(LEAST_SCALE, SIGNIFICANT * variance**0.5) and changed <= LARGEST_SCALE
    return float(scale) if clear else 1.0
