"""Surfaces that the other robot saw through: furniture tells rooms apart whose walls are the same."""

import numpy as np

from fcslam.geometry import se3
from fcslam.lidar3d.voxel_matching import PreparedMap, seen_through

WALLS = np.array([[-4.0, -3.0, 0.0], [4.0, 3.0, 2.5]])
CUPBOARD = np.array([[1.0, -2.9, 0.05], [2.2, -2.0, 1.9]])
BED = np.array([[-3.9, 0.5, 0.05], [-2.0, 2.0, 0.5]])
MAN = np.array([[-0.2, 0.0, 0.0], [0.2, 0.4, 1.7]])
ALONG, ACROSS = (np.column_stack((np.linspace(-2.0, 2.0, 9), np.full(9, y), np.full(9, 0.6))) for y in (-0.5, 1.0))


def seen(origins, *furniture, walks=False):
    """The map of the room from some origins; the last piece of furniture moves on between them if it ``walks``."""
    rng, points = np.random.default_rng(0), []
    for k, origin in enumerate(origins):
        rays = rng.normal(size=(4000, 3))
        distances = np.maximum((WALLS[0] - origin) / rays, (WALLS[1] - origin) / rays).min(axis=1)
        boxes = [*furniture[:-1], furniture[-1] + (0.4 * k - 1.6, 0.0, 0.0)] if walks else furniture
        for low, high in boxes:
            ends = np.sort(np.stack(((low - origin) / rays, (high - origin) / rays)), axis=0)
            near, far = ends[0].max(axis=1), ends[1].min(axis=1)
            distances = np.where((near < far) & (near > 0.0), np.minimum(distances, near), distances)
        points.append(origin + distances[:, None] * rays)
    return PreparedMap(np.concatenate(points), np.repeat(origins, 4000, axis=0))


def test_other_furniture_is_seen_through_and_the_same_from_elsewhere_is_not():
    one, other = seen(ALONG, CUPBOARD), seen(ALONG, BED)
    for query, target in ((one, other), (other, one)):
        known, through = seen_through(query, target, se3.IDENTITY)
        assert through > 0.003 * known
    known, through = seen_through(one, seen(ACROSS, CUPBOARD), se3.IDENTITY)
    assert known > 10_000
    assert through == 0


def test_people_who_walk_are_no_furniture():
    known, through = seen_through(seen(ALONG, CUPBOARD, MAN, walks=True), seen(ALONG, CUPBOARD), se3.IDENTITY)
    assert known > 10_000
    assert through == 0
