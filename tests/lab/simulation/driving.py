"""Routes for tests, and an oracle of how close they come to what stands around."""

import numpy as np

from fcslam.lab.simulation.route import draw_goals, plan_route, schedule


def route(plan, length_m, rng):
    """Waypoints of one robot."""
    return plan_route(plan, draw_goals(plan, 1, length_m, rng)[0], length_m, rng)


def drive(waypoints, period_s):
    """Sample a drive along waypoints (K, 2) every ``period_s``: times (N,) from zero and poses (N, 3)."""
    plan = schedule(waypoints)
    stamps = np.arange(0.0, plan.duration_s, period_s)
    return stamps, plan.at(stamps)


def distances(points, segments):
    """Distance of every point from its nearest segment, shape (N,)."""
    a, b = segments[:, :2], segments[:, 2:]
    along = b - a
    found = np.empty(len(points))
    for k, point in enumerate(points):  # an array of all points and segments does not fit into the cache
        share = np.sum((point - a) * along, axis=1) / np.sum(along**2, axis=1)
        off = a + np.clip(share, 0.0, 1.0)[:, None] * along - point
        found[k] = np.hypot(off[:, 0], off[:, 1]).min()
    return found
