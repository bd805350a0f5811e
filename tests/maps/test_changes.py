import cv2
import numpy as np

from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.changes import compare
from fcslam.maps.fusion import Period, fuse, fuse_periods, periods_of
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import Keyscan, KeyscanId, LaserModel
from tests.lidar.worlds import box, ranges

LASER = LaserModel(720, -np.pi, np.pi / 360, 30.0)
HALF_M = 3.02
CONFIG = OccupancyConfig()


def ranges_around(pose, boxes):
    """Ranges in a square room with square boxes (x, y, half side)."""
    sides = [box(x - half, y - half, x + half, y + half) for x, y, half in ((0.0, 0.0, HALF_M), *boxes)]
    return ranges(pose, np.vstack(sides), LASER)[0]


def session(name, start_s, boxes, seed=0):
    rng = np.random.default_rng(seed)
    poses = rng.uniform((-2.5, -2.5, -3.0), (-1.2, 2.5, 3.0), (15, 3))
    return [Keyscan(KeyscanId(name, k), start_s + k, ranges_around(pose, boxes)) for k, pose in enumerate(poses)], poses


def together(*sessions):
    keyscans = [keyscan for scans, _ in sessions for keyscan in scans]
    return keyscans, np.concatenate([poses for _, poses in sessions]), {k.id.robot: (LASER,) for k in keyscans}


def changed(*sessions):
    keyscans, poses, lasers = together(*sessions)
    periods = periods_of(keyscans)
    return compare(list(fuse_periods(keyscans, poses, lasers, CONFIG, periods)), periods)


def test_sessions_that_overlap_in_time_share_a_period():
    keyscans, _, _ = together(session("a", 0.0, ()), session("b", 10.0, ()), session("c", 25.0, ()))
    assert periods_of(keyscans) == [Period(("a", "b"), 0.0, 24.0), Period(("c",), 25.0, 39.0)]
    assert periods_of([]) == []


def test_sessions_of_one_period_are_fused_as_one():
    box = (1.0, 0.0, 0.4)
    first, second = session("a", 0.0, (box,)), session("b", 5.0, (), seed=1)
    keyscans, poses, lasers = together(first, second)
    renamed = [Keyscan(KeyscanId("a", k), 0.0, keyscan.ranges_m) for k, keyscan in enumerate(keyscans)]
    assert np.array_equal(fuse(keyscans, poses, lasers, CONFIG).cells, fuse(renamed, poses, lasers, CONFIG).cells)


def test_nothing_changed_where_nothing_changed_or_nobody_looked():
    box = (1.0, 0.0, 0.3)
    found = changed(session("a", 0.0, [box]), session("a+1", 100.0, [box], seed=1))
    assert found.regions == ()
    assert not found.appeared.any()
    in_front = (0.0, 0.0, 0.6)  # hides the box behind it
    hidden = changed(session("a", 0.0, [box]), session("a+1", 100.0, [in_front], seed=1))
    assert {region.kind for region in hidden.regions} == {"appeared"}


def test_layers_say_where_both_times_were_seen():
    found = changed(session("a", 0.0, [(1.0, 1.0, 0.3)]), session("a+1", 100.0, [], seed=1))
    layer = found.layer(found.disappeared)
    assert layer.cells.shape == found.now.cells.shape
    assert np.array_equal(layer.cells == Occupancy.OCCUPIED, found.disappeared)
    assert (layer.cells[~found.compared] == Occupancy.UNKNOWN).all()
    assert found.disappeared.any()
    assert not found.appeared.any()


def test_the_picture_has_both_colours_and_a_legend():
    cells = np.full((40, 60), Occupancy.FREE, np.uint8)
    now, then = cells.copy(), cells.copy()
    now[5:12, 5:12], then[25:32, 40:47] = Occupancy.OCCUPIED, Occupancy.OCCUPIED
    maps = [OccupancyMap(grid, 0.05, (0.0, 0.0)) for grid in (then, now)]
    found = compare(maps, [Period(("a",), 0.0, 1.0), Period(("b",), 2.0, 3.0)])
    picture = cv2.imdecode(np.frombuffer(found.png(), np.uint8), cv2.IMREAD_COLOR)
    for color in ((0x00, 0x61, 0xE6), (0xB2, 0x72, 0x00)):
        assert (picture == color).all(axis=2).sum() > 1000
