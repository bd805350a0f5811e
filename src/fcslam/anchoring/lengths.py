"""The lengths of a map compared with those of a floor plan."""

from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.field import EMPTY
from fcslam.lidar.matching import OPPOSED
from fcslam.lidar.submap import Submap
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
