"""Drawn flats and a corridor, for tests of which maps may join."""

import numpy as np

from tests.lidar.worlds import Recording, box, drifting, drive, path, recording

WALLS = np.vstack(
    (
        box(0, 0, 9, 8),
        box(0, 4.45, 2.2, 4.6),
        box(3.1, 4.45, 5.5, 4.6),
        box(5.5, 4.45, 5.65, 5.6),
        box(5.5, 6.5, 5.65, 8),
        box(5.8, 0, 5.95, 2.6),
        box(5.8, 3.4, 9, 3.55),
    )
)
ROUND = [(1.2, 1.3), (4.6, 1.2), (4.7, 3.6), (2.6, 3.8), (2.6, 5.6), (1.5, 6.6), (4.4, 6.4), (2.6, 5.4), (2.7, 3.2)]
"""Corners of a drive through two rooms."""
BACK = [(4.5, 6.2), (1.4, 5.8), (2.6, 5.3), (2.7, 3.4), (1.3, 1.5), (4.4, 1.7), (4.9, 3.2), (3.0, 2.6)]


def furnished(*furniture):
    """The flat's walls with boxes (x, y, width, depth)."""
    return np.vstack((WALLS, *(box(x, y, x + width, y + depth) for x, y, width, depth in furniture)))


def flat():
    """Three rooms with furniture."""
    return furnished(
        (0.1, 0.1, 0.8, 0.5), (3.2, 2.2, 0.6, 0.9), (0.3, 2.6, 0.5, 1.2), (3.4, 7.2, 1.4, 0.6), (7, 6, 1, 1)
    )


def lookalike():
    """The same walls with other furniture: another flat of the same house."""
    return furnished(
        (3.1, 0.1, 1.5, 0.5), (0.1, 1.4, 0.6, 1.4), (2.0, 2.2, 0.5, 0.5), (0.2, 7.0, 1.6, 0.8), (4.6, 5.0, 0.7, 0.7)
    )


def mirrored():
    """The flat as in a mirror, moved back to positive x."""
    segments = flat() * np.array([-1.0, 1.0, -1.0, 1.0]) + np.array([9.0, 0.0, 9.0, 0.0])
    return segments[:, [2, 3, 0, 1]]


def doors(count=16, period_m=2.5):
    """A corridor 2 m wide whose doors are all equal."""
    sides = []
    for k in range(count):
        x = k * period_m
        for y, depth in ((-1.0, -0.25), (1.0, 0.25)):
            sides.append(path((x, y), (x + 1.4, y), (x + 1.4, y + depth), (x + period_m, y + depth), (x + period_m, y)))
    return np.vstack(sides)


class Drive(Recording):
    """A recording of one robot that drives through a drawn world, with drifting odometry."""

    def __init__(self, name, waypoints, segments, seed=0, **options):
        self.poses = drive(waypoints)
        odometry = drifting(self.poses, np.random.default_rng(seed), scale=1.005, veer_rad_m=0.002, noise=0.003)
        super().__init__(recording(self.poses, odometry, segments, seed=seed, **options), name)
