"""Light in the building: positions of lamps, failed lamps, and ambient light."""

from dataclasses import dataclass

import numpy as np

from fcslam.lab.simulation.floorplan import FloorPlan
from fcslam.lab.simulation.options import Lighting
from fcslam.records import FloatArray, frozen

LAMP_HEIGHT_M = 2.4
_LAMP_SPACING_M = 6.0
"""Distance of lamps along a corridor, about."""


@dataclass(frozen=True, slots=True)
class Light:
    """The light during one robot's recording."""

    lamps: FloatArray
    """Positions of the working lamps in ``building``, shape (L, 3), metres."""
    lamp_rgb: tuple[float, float, float]
    """Intensity of a lamp, each colour in [0, 1]."""
    ambient_rgb: tuple[float, float, float]
    """Intensity of the ambient light, each colour in [0, 1]."""


def light_of(plan: FloorPlan, lighting: Lighting, rng: np.random.Generator) -> Light:
    """Light a building; the generator chooses the lamps that fail."""
    lamps = _lamps(plan)
    if lighting is Lighting.EVENING:
        return Light(lamps, (0.52, 0.40, 0.24), (0.14, 0.11, 0.09))
    if lighting is Lighting.LAMP_OFF:
        failed = rng.choice(len(lamps), max(1, len(lamps) // 3), replace=False)
        lamps = frozen(np.delete(lamps, failed, axis=0))
    return Light(lamps, (0.34, 0.34, 0.32), (0.40, 0.41, 0.44))


def _lamps(plan: FloorPlan) -> FloatArray:
    """Positions of lamps, one in the middle of every room and some along each corridor, shape (L, 3)."""
    points = [(room.low + room.high) / 2.0 for room in plan.rooms]
    for start, end in plan.lanes:
        count = max(2, round(float(np.linalg.norm(end - start)) / _LAMP_SPACING_M) + 1)
        points += [start + share * (end - start) for share in np.linspace(0.0, 1.0, count)]
    return frozen(np.column_stack((np.array(points), np.full(len(points), LAMP_HEIGHT_M))))
