"""A robot closes its own loops by their looks: however far it drifted, and never with a similar place elsewhere."""

from functools import lru_cache

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.closing import LoopCloser
from fcslam.lidar.submap import build_submap
from fcslam.robot.backend import OwnPlaces
from tests.lidar.worlds import box, chain, path, scan_at, shifted

pytestmark = pytest.mark.slow

STEP_M = 1.0
RADIUS_M = 32.0
VEER_RAD_M = 0.006
"""Over a loop of 200 m the heading is wrong by 69 deg and the position by 35 m."""


def blocks():
    """Many blocks of chance sizes inside and outside a circular road."""
    rng = np.random.default_rng(2)
    found = []
    for angle in np.arange(0.0, 2 * np.pi, 0.12):
        for radius in (RADIUS_M - 6.0, RADIUS_M + 6.0):
            middle = (radius + rng.uniform(-2, 2)) * np.array([np.cos(angle), np.sin(angle)])
            size = rng.uniform(0.4, 1.6, 2)
            found.append(box(*(middle - size), *(middle + size)))
    return np.vstack(found)


def lap(length_m, step_m=STEP_M):
    """Poses along the road."""
    angles = np.arange(0.0, length_m, step_m) / RADIUS_M
    return np.stack((RADIUS_M * np.cos(angles), RADIUS_M * np.sin(angles), angles + np.pi / 2), axis=1)


def equal_doors():
    """A corridor 2 m wide whose two niches repeat each 8 m."""
    below = path((0, -1), (3, -1), (3, -1.6), (4, -1.6), (4, -1), (8, -1))
    above = path((0, 1), (5, 1), (5, 1.7), (6, 1.7), (6, 1), (8, 1))
    cell = np.vstack((below, above))
    return np.vstack([shifted(cell, 8.0 * k, 0.0) for k in range(-4, 25)])


def veering(truth):
    """The drive as a robot believes it that turns too far."""
    motions = se2.relative(truth)
    motions[:, 2] += VEER_RAD_M * np.hypot(motions[:, 0], motions[:, 1])
    return chain(motions, truth[0])


@lru_cache
def submaps_of(world, length_m):
    truth = lap(length_m) if world is blocks else np.array([(x, 0.0, 0.0) for x in np.arange(0.0, length_m, STEP_M)])
    segments, rng = world(), np.random.default_rng(1)
    scans = [scan_at(pose, segments, noise_m=0.01, rng=rng) for pose in truth]
    submaps = []
    for anchor in range(0, len(truth), 2):
        near = range(max(0, anchor - 5), min(len(truth), anchor + 6))
        submap = build_submap([(scans[k], se2.between(truth[anchor], truth[k])) for k in near])
        submaps.append((anchor, submap))
    return truth, submaps


def closures(submaps, poses, recognizer):
    closer = LoopCloser(recognizer)
    anchors = poses[[anchor for anchor, _ in submaps]]
    found = [closer.add(at, at * STEP_M, submap, anchors[: k + 1]) for k, (at, submap) in enumerate(submaps)]
    return [(2 * c.earlier, 2 * c.later, c) for closures in found for c in closures]


def test_a_loop_whose_drift_is_beyond_the_search_is_closed():
    truth, submaps = submaps_of(blocks, 225.0)
    poses = veering(truth)
    end = 200
    drift = se2.between(se2.between(poses[0], poses[end]), se2.between(truth[0], truth[end]))
    assert np.hypot(drift[0], drift[1]) > 25.0
    assert closures(submaps, poses, None) == []
    found = closures(submaps, poses, OwnPlaces())
    assert len(found) >= 3
    for i, j, closure in found:
        error = se2.between(se2.between(truth[i], truth[j]), closure.check.T_a_b)
        assert np.hypot(error[0], error[1]) < 0.2


def test_what_is_forgotten_is_not_recognised():
    _, submaps = submaps_of(blocks, 60.0)
    places = OwnPlaces()
    for anchor, submap in submaps[:10]:
        places.store(anchor, submap.surface.points)
    keyscans = [anchor for anchor, _ in submaps[:10]]
    places.forget(keyscans[0])  # before the index has it, and after
    assert set(places.most_similar(keyscans[9], keyscans, 10)) <= set(keyscans[1:])
    places.forget(keyscans[9 - 1])
    assert keyscans[8] not in places.most_similar(keyscans[9], keyscans, 10)


def test_places_that_look_alike_do_not_close_a_loop():
    truth, submaps = submaps_of(equal_doors, 180.0)
    assert closures(submaps, truth, OwnPlaces()) == []
