"""Where a map lies in a floor plan, conclusive or not at all and why not; and its lengths compared with the plan's."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fcslam.anchoring.plan import UNITS_M, BuildingPlan, sides_m, unit_of
from fcslam.geometry import se2
from fcslam.graph.evidence import LEAD
from fcslam.lidar.field import EMPTY
from fcslam.lidar.matching import OPPOSED
from fcslam.lidar.submap import ON_SURFEL_M, SPACING_M, Submap, agreement
from fcslam.records import FloatArray

LARGEST_SCALE: Final = 0.03
"""Largest difference of a robot's scale from 1 that is found."""
SIGNIFICANT: Final = 3.0
"""A scale counts if it differs from 1 by this many standard deviations, and by ``LEAST_SCALE``."""
LEAST_SCALE: Final = 1e-3
_WIDTHS_M: Final = (0.4, 0.3, 0.2, 0.15, 0.1, 0.1, 0.06, 0.06, 0.06, 0.06)
"""Scales of the robust loss in the steps that find the scale."""
_CORRELATED: Final = 20.0
"""Points of a wall whose errors are those of one point."""
LEAST_EXPLAINED: Final = 0.7
"""Least share of the plan's surface in the known area of the map that the scans saw."""
MOST_VIOLATION: Final = 0.25
"""Largest share of it that stands in free space of the map."""
LEAST_SURFACE_M: Final = 25.0
"""Least length of the plan's surface that the scans saw, and of the map's surface that the plan has."""
LEAST_SHARE: Final = 0.3
"""Least share of the surface of a map, or of a scan, that the plan has: the rest is furniture."""
LEAST_RIVAL_M: Final = 0.4 * LEAST_SURFACE_M
"""Score of an alignment elsewhere that is always assumed."""
USUAL_WALL_M: Final = 0.08
"""Half of the width of a wall: wider lines that fit no map as they are drawn are taken for walls of this width."""
MOST_THICKNESS_M: Final = ON_SURFEL_M
"""Walls that differ in thickness by less on each side are drawn as lines of another width, or as one line."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanAlignment:
    """The best alignment of a map with a floor plan."""

    plan: BuildingPlan
    """The plan, with walls as thick as those of the map."""
    T_plan_map: FloatArray
    """Shape (3,), metres and radians."""
    explained: float
    """Share of the plan's surface in the known area of the map that the scans saw."""
    violation: float
    """Share of it that stands in free space of the map."""
    surface_m: float
    """Length of surface that plan and map share."""
    share: float
    """Share of the map's surface that the plan has."""
    lead: float
    """Ratio of the score to that of the best alignment elsewhere; inf if a user placed the map."""

    @property
    def refusal(self) -> str:
        """Why it is not conclusive; empty if it is."""
        if self.surface_m < LEAST_SURFACE_M:
            return f"plan and map share {self.surface_m:.0f} m of walls, {LEAST_SURFACE_M:.0f} m needed"
        if self.explained < LEAST_EXPLAINED:
            seen = f"the scans saw {self.explained:.0%} of the plan's walls there, {LEAST_EXPLAINED:.0%} needed"
            return f"{seen}; is its scale right?"
        if self.violation > MOST_VIOLATION:
            return f"{self.violation:.0%} of the plan's walls stand in free space, {MOST_VIOLATION:.0%} allowed"
        if self.share < LEAST_SHARE:
            return f"the plan has {self.share:.0%} of the map's walls, {LEAST_SHARE:.0%} needed"
        if self.lead < LEAD:
            return (
                f"the map fits the plan elsewhere, too: the best alignment is {self.lead:.1f} times as good, "
                f"{LEAD:g} times needed; place the map by hand: fcslam edit place RUN --match"
            )
        return ""


def align_to_plan(plan: BuildingPlan, building: Submap, placed: bool) -> PlanAlignment | None:
    """The best alignment of a whole map with a plan, conclusive or not; None if the map has no walls.

    It is looked for from all positions, at headings that make walls parallel. A map that is ``placed`` lies
    about there in the plan already, and no other place is looked for.
    """
    tries, wider_m = [_aligned(plan, building, placed)], plan.half_width_m - USUAL_WALL_M
    if wider_m > 0.0 and tries[0] is not None and tries[0].refusal:
        tries.append(_aligned(replace(plan, thickness_m=-wider_m), building, placed))
    return max(filter(None, tries), key=lambda each: (not each.refusal, each.surface_m), default=None)


def _aligned(plan: BuildingPlan, building: Submap, placed: bool) -> PlanAlignment | None:
    """The best alignment with a plan whose walls are about as thick as it says."""
    # SciPy's transforms take long to load.
    from fcslam.lidar.uniqueness import align_map, best_alignment, is_elsewhere, parallel_headings

    if not len(building.surface):
        return None
    target = plan.submap
    if placed:
        best, lead = align_map(target, building, np.zeros(3)), np.inf
        if is_elsewhere(best.T_a_b, np.zeros(3), building.surface.points.mean(axis=0, keepdims=True)):
            best = align_map(target, building, best.T_a_b)
    else:
        found = best_alignment(target, building, LEAST_RIVAL_M, parallel_headings(target, building))
        if found is None:
            return None
        best, lead = found
    _, thickness_m = lengths_in_plan(target, building, best.T_a_b)
    if 0.0 < abs(thickness_m) < MOST_THICKNESS_M:
        plan = replace(plan, thickness_m=plan.thickness_m + thickness_m)
        target = plan.submap
        best = align_map(target, building, best.T_a_b)
    of_plan = agreement(target, building, se2.inverse(best.T_a_b))
    of_map = agreement(building, target, best.T_a_b)
    surface_m = SPACING_M * min(of_plan.count, of_map.count)
    share = of_map.count / len(building.surface)
    return PlanAlignment(plan, best.T_a_b, of_plan.explained, of_plan.violation, surface_m, share, lead)


def misfit(plan: BuildingPlan, building: Submap) -> str:
    """The sizes of a plan and of a map that do not fit, and what makes them fit; a part of a sentence."""
    shorter_m, longer_m = plan.sides_m
    its_shorter_m, its_longer_m = sides_m(building.surface.points)
    said = (
        f"the plan is {shorter_m:.1f} m by {longer_m:.1f} m, and the map {its_shorter_m:.1f} m by {its_longer_m:.1f} m"
    )
    factor, unit_m = its_longer_m / longer_m, plan.unit_m or 0.0
    if unit := unit_of(unit_m):
        usual_m, name = min(UNITS_M, key=lambda each: abs(np.log(each[0] / (factor * unit_m))))
        if name != unit and abs(np.log(usual_m / (factor * unit_m))) < 0.5:  # one may show more than the other
            return f"{said}; if it is drawn in {name} and not in {unit}: --plan-scale {usual_m:g}"
    for other in () if plan.submap.field.is_full else (plan.mirrored(), plan.scaled(factor)):
        alignment = align_to_plan(other, building, placed=False)
        if alignment is None or alignment.refusal:
            continue
        if other.drawing.resolution_m == plan.drawing.resolution_m:
            return f"{said}; it fits mirrored"
        factor /= lengths_in_plan(other.submap, building, alignment.T_plan_map)[0]
        return f"{said}; it fits at {factor:.3f} of its size{f': --plan-scale {factor * unit_m:.4g}' * (unit_m > 0.0)}"
    return said


def lengths_in_plan(plan: Submap, building: Submap, T_plan_map: FloatArray) -> tuple[float, float]:
    """Compare the lengths of a map with those of a plan, by the walls of both.

    Motion, scale and thickness of the walls are found together: a plan that shows the middle lines of walls makes no
    building larger. The map, or one robot's part of it, lies about at ``T_plan_map``, shape (3,), metres and radians.

    Returns:
        The factor that brings the map's lengths into the scale of the plan, 1 if it is not clearly another, and by how
        much the sides of walls lie farther from their middle than the plan draws them, metres.
    """
    points, normals = se2.transform(T_plan_map, building.surface.points), building.surface.normals
    if not len(points):
        return 1.0, 0.0
    middle, field = points.mean(axis=0), plan.field
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
            return 1.0, 0.0
        across = np.einsum("na,na->n", its, apart)
        along2 = np.maximum(0.0, np.einsum("na,na->n", apart, apart) - across**2)
        off = across - thickness
        weight = (width_m**2 / (width_m**2 + off**2 + 0.25 * along2)) ** 2
        J = np.column_stack(
            (its, its[:, 1] * arms[:, 0] - its[:, 0] * arms[:, 1], np.einsum("na,na->n", its, arms), -np.ones(len(its)))
        )
        H = J.T @ (weight[:, None] * J) + 1e-6 * np.eye(5)
        step = -np.linalg.solve(H, J.T @ (weight * off))
        motion, scale, thickness = motion + step[:3], scale * (1.0 + step[3]), thickness + step[4]
        variance = _CORRELATED * float((weight * off**2).sum() / weight.sum()) * float(np.linalg.inv(H)[3, 3])
    changed = abs(scale - 1.0)
    clear = changed > max(LEAST_SCALE, SIGNIFICANT * variance**0.5) and changed <= LARGEST_SCALE
    return float(scale) if clear else 1.0, float(thickness)
