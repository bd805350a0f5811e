"""Local maps of two sessions, around the places that both saw."""

import numpy as np

from fcslam.geometry import se3
from fcslam.geometry.groups import SE3
from fcslam.places.local_maps import SessionMaps


def test_a_local_map_holds_the_keyscans_of_one_floor_only() -> None:
    ground = se3.from_plane(np.array([(0.5 * k, 0.0, 0.0) for k in range(20)]))
    upstairs = SE3.compose(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0]), ground)
    poses = np.concatenate((ground, upstairs))
    maps = SessionMaps(np.arange(len(poses)), lambda _: None, poses)
    keyscans, nearest, is_complete = maps.around(np.array([5.1, 0.0, 2.9]))
    assert set(keyscans) == set(range(20, 40))
    assert nearest == 30
    assert is_complete
