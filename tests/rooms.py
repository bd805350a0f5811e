"""Drawings of rooms, for tests of what is seen in them."""

import numpy as np

WALLS = [
    ((-8, -6), (7, -6)),
    ((7, -6), (7, 3)),
    ((7, 3), (2, 3)),
    ((2, 3), (2, 8)),
    ((2, 8), (-5, 8)),
    ((-5, 8), (-5, 1.5)),
    ((-8, -6), (-8, 1.5)),
    ((-8, 1.5), (-3, 1.5)),
    ((-1.5, 1.5), (-0.2, 1.5)),
    ((-4, -6), (-4, -3.5)),
    ((1.5, -6), (1.5, -4.2)),
    ((3, -1.5), (5, -0.5)),
    ((5, -0.5), (4.6, 0.6)),
    ((-6.5, -1.5), (-5.2, -2.4)),
    ((-3, 5), (-1.2, 6)),
    ((-1.2, 6), (-0.8, 5.1)),
]


def asymmetric_room(rng, spacing_m=0.05, noise_m=0.01):
    """Points (N, 2) on the walls of a room that looks like no turned or shifted copy of itself."""
    points = []
    for start, end in np.asarray(WALLS, dtype=float):
        count = int(np.linalg.norm(end - start) / spacing_m)
        points.append(start + np.linspace(0.0, 1.0, count)[:, None] * (end - start))
    walls = np.concatenate(points)
    return walls + rng.normal(0.0, noise_m, walls.shape)
