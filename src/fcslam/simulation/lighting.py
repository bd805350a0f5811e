"""Light in the building: where lamps hang, which of them burn, and how bright it is without them."""

from dataclasses import dataclass

import numpy as np

from fcslam.records import FloatArray, frozen
from fcslam.simulation.floorplan import FloorPlan
from fcslam.simulation.options import Lighting

LAMP_HEIGHT_M = 2.4
_LAMP_SPACING_M = 6.0
"""Along a corridor."""


@dataclass(frozen=True, slots=True)
class Light:
    """All light of one robot's world."""

    lamps: FloatArray
    """Where those hang that burn, shape (L, 3)."""
    lamp_rgb: tuple[float, float, float]
    ambient_rgb: tuple[float, float, float]
    """What comes from everywhere."""


def light_of(plan: FloorPlan, lighting: Lighting, rng: np.random.Generator) -> Light:
    """The lamps of a building under one kind of lighting; the generator says which of them fail."""
    lamps = _lamps(plan)
    if lighting is Lighting.EVENING:
        return Light(lamps, (0.52, 0.40, 0.24), (0.14, 0.11, 0.09))
    if lighting is Lighting.LAMP_OFF:
        failed = rng.choice(len(lamps), max(1, len(lamps) // 3), replace=False)
        lamps = frozen(np.delete(lamps, failed, axis=0))
    return Light(lamps, (0.34, 0.34, 0.32), (0.40, 0.41, 0.44))


def _lamps(plan: FloorPlan) -> FloatArray:
    """One in the middle of every room, and some along each corridor, shape (L, 3)."""
    points = [(room.low + room.high) / 2.0 for room in plan.rooms]
    for start, end in plan.lanes:
        count = max(2, round(float(np.linalg.norm(end - start)) / _LAMP_SPACING_M) + 1)
        points += [start + share * (end - start) for share in np.linspace(0.0, 1.0, count)]
    return frozen(np.column_stack((np.array(points), np.full(len(points), LAMP_HEIGHT_M))))
