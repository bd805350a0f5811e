"""LiDAR places of a recording, and what agrees in the plane."""

import numpy as np
import pytest
from evaluation.place_features import PlaceFeatures, describe_recording, planar_inliers

from fcslam.geometry import se2
from tests import small_fleet
from tests.carmen_logs import write_carmen


@pytest.mark.slow
def test_places_of_a_recording_are_asked_for_long_after(tmp_path):
    (robot,) = small_fleet.draw(1, 30.0).robots
    write_carmen(tmp_path / "a.clf", robot.scans())
    found = describe_recording(tmp_path / "a.clf")
    (truth,) = found.place_set.questions.values()
    count = len(found.queries)
    assert count > 5
    assert found.place_set.is_online
    assert all(len(place.positions) == len(place.descriptors) for place in found.gallery)
    assert not np.triu(found.place_set.admitted).any()
    assert not ((truth.matches | truth.different) & ~found.place_set.admitted).any()
    lags = [np.flatnonzero(row).max() - q for q, row in enumerate(found.place_set.admitted) if row.any()]
    assert lags
    assert all(lag < -3 for lag in lags)  # a minute is several places


def test_what_agrees_is_what_a_rigid_motion_moves():
    rng = np.random.default_rng(2)
    positions = rng.uniform(-10, 10, (60, 2))
    codes = rng.integers(0, 256, (60, 32), dtype=np.uint8)
    here = PlaceFeatures(positions.astype(np.float32), codes)
    moved = PlaceFeatures(se2.transform((3.0, -2.0, 2.5), positions[:40]).astype(np.float32), codes[:40])
    scattered = PlaceFeatures(rng.uniform(-10, 10, (60, 2)).astype(np.float32), codes)
    assert planar_inliers(here, moved) == 40
    assert planar_inliers(here, scattered) < 8
