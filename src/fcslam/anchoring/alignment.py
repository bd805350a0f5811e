"""Where a map lies in a floor plan: conclusive, or not at all and why not."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fcslam.anchoring.lengths import lengths_in_plan
from fcslam.anchoring.plan import BuildingPlan
from fcslam.geometry import se2
from fcslam.graph.evidence import LEAD
from fcslam.lidar.submap import ON_SURFEL_M, SPACING_M, Submap, agreement
from fcslam.records import FloatArray

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
MOST_THICKNESS_M: Final = ON_SURFEL_M
"""Walls that differ in thickness by less on each side are drawn as lines of another width, or as one line."""
DIRECTED: Final = 0.5
"""Least length of the mean direction of walls, modulo a right angle, from which headings are chosen."""


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

    It is looked for from all positions, and by the directions of walls or all headings. A map that is ``placed`` lies
    about there in the plan already, and no other place is looked for.
    """
    from fcslam.lidar.uniqueness import align_map, best_alignment, is_elsewhere  # SciPy's transforms take long to load

    target = plan.submap
    if not len(building.surface):
        return None
    if placed:
        best, lead = align_map(target, building, np.zeros(3)), np.inf
        if is_elsewhere(best.T_a_b, np.zeros(3), building.surface.points.mean(axis=0, keepdims=True)):
            best = align_map(target, building, best.T_a_b)
    else:
        found = best_alignment(target, building, LEAST_RIVAL_M, _headings(target, building))
        if found is None:
            return None
        best, lead = found
    _, thickness_m = lengths_in_plan(target, building, best.T_a_b)
    if 0.0 < abs(thickness_m) < MOST_THICKNESS_M:
        plan = replace(plan, thickness_m=thickness_m)
        target = plan.submap
        best = align_map(target, building, best.T_a_b)
    of_plan = agreement(target, building, se2.inverse(best.T_a_b))
    of_map = agreement(building, target, best.T_a_b)
    surface_m = SPACING_M * min(of_plan.count, of_map.count)
    share = of_map.count / len(building.surface)
    return PlanAlignment(plan, best.T_a_b, of_plan.explained, of_plan.violation, surface_m, share, lead)


def _headings(plan: Submap, building: Submap) -> FloatArray | None:
    """Headings of the map over half a turn at which the walls of both are parallel, shape (2,), radians; None: walls of
    no direction."""
    directions = []
    for submap in (plan, building):
        normals = submap.surface.normals[np.any(submap.surface.normals != 0.0, axis=1)]
        mean = complex(np.exp(4j * np.arctan2(normals[:, 1], normals[:, 0])).mean()) if len(normals) else 0j
        if abs(mean) < DIRECTED:
            return None
        directions.append(float(np.angle(mean)) / 4.0)
    return np.asarray(directions[0] - directions[1] + 0.5 * np.pi * np.arange(2), np.float64)
