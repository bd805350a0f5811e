"""A map fitted to a floor plan: the scale of each robot's ranges, and poses that the walls of the plan correct."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from fcslam.anchoring.alignment import LEAST_SHARE, lengths_in_plan
from fcslam.anchoring.deviations import Comparison, compare_with_plan
from fcslam.anchoring.part import ROUNDS, MapPart
from fcslam.anchoring.plan import BuildingPlan
from fcslam.cloud.result import MappedRobot
from fcslam.geometry import se2
from fcslam.geometry.groups import SE2
from fcslam.graph.optimizer import PosePrior, optimize_anchored
from fcslam.graph.pose_graph import PoseGraph
from fcslam.lidar import matching
from fcslam.lidar.field import CELL_M
from fcslam.lidar.matching import match_scan
from fcslam.lidar.scan import PointScan, keyscan_points
from fcslam.lidar.submap import Submap, build_submap
from fcslam.maps.certificate import QUIET
from fcslam.records import FloatArray, frozen

WEAK_M, WEAK_RAD = 0.05, 0.02
"""Least standard deviations of a pose by the plan, which is no more precise, however many points agree."""
POINT_SIGMA_M: Final = 0.15
"""Standard deviation of a wall in the plan, per point of a scan: errors of a plan are the same for all its points."""

MOST_RISE: Final = 2.0
"""A plan that raises the residuals by more is drawn less exactly than the map."""
LEAST_FALL: Final = 0.8
"""Bending brings the walls nearer to the plan by at least this factor, or the map keeps its shape."""


def map_submap(robots: Sequence[MappedRobot]) -> Submap:
    """The whole map of robots that share one; one of them has a keyscan."""
    scans = [
        (keyscan_points(keyscan, robot.lasers), robot.T_map_base[row])
        for robot in robots
        for keyscan, row in zip(robot.keyscans, robot.numbers().tolist(), strict=True)
    ]
    return build_submap(scans, np.inf)


class PlanFit(NamedTuple):
    """A map in the plan."""

    part: MapPart
    """With ranges in the scale of the plan."""
    scales: dict[str, float]
    """Scale of each robot's lengths."""
    residuals: tuple[float, float]
    """Root mean square residual of the scans, in standard deviations: as the map was, and bent to the plan."""
    compared: tuple[Comparison, Comparison]
    """With the plan, as the map was, and bent to it."""

    @property
    def is_bent(self) -> bool:
        """Whether bending earns it: walls lie on the plan, and the scans do not contradict it."""
        rises = self.residuals[1] > MOST_RISE * (self.residuals[0] + QUIET)
        return not rises and self.compared[1].mean_off_m < LEAST_FALL * self.compared[0].mean_off_m


def fit_to_plan(plan: BuildingPlan, part: MapPart, T_plan_map: FloatArray) -> PlanFit:
    """Fit a map to the plan, from its alignment ``T_plan_map``, shape (3,), metres and radians."""
    robots, graph = part.robots, part.graph
    found = {
        robot.robot: lengths_in_plan(plan.submap, map_submap([robot]), T_plan_map)[0] if robot.keyscans else 1.0
        for robot in robots
    }
    middle = np.append(plan.submap.surface.points.mean(axis=0), 0.0)
    # A robot's poses grow about the middle of the plan; solving puts them right.
    scaled = [_scaled(robot, found[robot.robot]) for robot in robots]
    owner = np.zeros(len(graph), np.int64)
    for number, robot in enumerate(robots):
        owner[robot.variables] = number
    lengths = np.array([found[robot.robot] for robot in robots])[owner]
    edges = graph.given()
    T_i_j = edges.T_i_j.copy()
    T_i_j[:, :2] *= (lengths[edges.i] ** 0.5 * lengths[edges.j] ** 0.5)[:, None]
    poses = se2.compose(T_plan_map, graph.poses())
    poses[:, :2] = middle[:2] + (poses[:, :2] - middle[:2]) * lengths[:, None]
    fitted = MapPart(tuple(scaled), PoseGraph.restored(poses, replace(edges, T_i_j=T_i_j)))
    scans = [
        (int(robot.variables[row]), keyscan_points(keyscan, robot.lasers).thinned(CELL_M))
        for robot in scaled
        for keyscan, row in zip(robot.keyscans, robot.numbers().tolist(), strict=True)
    ]
    for number in range(ROUNDS):
        priors = _priors(plan, scans, poses, wide_scale_m=0.4 if number == 0 else 0.2)
        if number:
            priors = [prior for prior in priors if prior.chi2(poses) < SE2.chi2_limit]
        if not priors:
            break
        poses = optimize_anchored(fitted.graph, poses, priors)
    both = part.at(se2.compose(T_plan_map, part.graph.poses())), fitted.at(poses)
    compared = [compare_with_plan(plan.submap, map_submap(one.robots)) for one in both]
    fit = PlanFit(both[1], found, (_residual(both[0]), _residual(both[1])), (compared[0], compared[1]))
    return fit if fit.is_bent else fit._replace(part=both[0], scales=dict.fromkeys(found, 1.0))


def _residual(part: MapPart) -> float:
    return float(np.sqrt(part.graph.chi2().mean())) if part.graph.edge_count else 0.0


def _scaled(robot: MappedRobot, scale: float) -> MappedRobot:
    if scale == 1.0:
        return robot
    lengths = np.array((scale, scale, 1.0))
    return replace(
        robot,
        keyscans=tuple(
            replace(keyscan, ranges_m=frozen(keyscan.ranges_m * np.float32(scale), np.float32))
            for keyscan in robot.keyscans
        ),
        lasers=tuple(replace(laser, max_range_m=laser.max_range_m * scale) for laser in robot.lasers),
        T_local_base=frozen(robot.T_local_base * lengths),
    )


def _priors(
    plan: BuildingPlan, scans: Sequence[tuple[int, PointScan]], poses: FloatArray, wide_scale_m: float
) -> list[PosePrior]:
    priors = []
    for variable, scan in scans:
        found = match_scan(scan, plan.submap.field, poses[variable], np.zeros((3, 3)), wide_scale_m=wide_scale_m)
        if found.explained < LEAST_SHARE:
            continue
        information = found.information * (matching.POINT_SIGMA_M / POINT_SIGMA_M) ** 2 + 1e-2 * np.eye(3)
        covariance = np.linalg.inv(information) + np.diag((WEAK_M**2, WEAK_M**2, WEAK_RAD**2))
        information = np.linalg.inv(covariance)
        priors.append(PosePrior(variable, found.T_field_base, 0.5 * (information + information.T)))
    return priors
