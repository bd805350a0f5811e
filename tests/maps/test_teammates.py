"""Robots that see each other in a room: they leave no ghosts, and nobody hides a wall by a false pose."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.fusion import fuse
from fcslam.maps.occupancy_map import Occupancy
from fcslam.records import Keyscan, KeyscanId, LaserModel
from tests.lidar.worlds import box, ranges, with_disc

BEAMS, SIDE_M, RADIUS_M = 360, 8.0, 0.25
LASER = LaserModel(BEAMS, -np.pi, 2 * np.pi / BEAMS, 20.0)
CONFIG = OccupancyConfig()


def seen(pose, others):
    """What a laser measures in a square room with other robots as discs."""
    ranges_m = ranges(pose, box(0.0, 0.0, SIDE_M, SIDE_M), LASER)[0]
    for other in others:
        ranges_m = with_disc(ranges_m, pose, other[:2], RADIUS_M, LASER)
    return ranges_m


def drive(ways, claimed=None):
    """Keyscans and poses of robots that drive at the same time; ``claimed``: poses that a robot sends in place of its
    own, by name."""
    keyscans, poses = [], []
    for name, way in ways.items():
        for number, pose in enumerate(way):
            others = [other[number] for mate, other in ways.items() if mate != name]
            keyscans.append(Keyscan(KeyscanId(name, number), float(number), seen(pose, others)))
            poses.append((claimed or {}).get(name, way)[number])
    return keyscans, np.array(poses)


def line(begin, end, count=25):
    return np.stack([np.linspace(*ends, count) for ends in zip((*begin, 0.0), (*end, 0.0), strict=True)], axis=-1)


MEETING = {"a": line((2.0, 3.0), (6.0, 3.0)), "b": line((6.0, 3.8), (2.0, 3.8)), "c": line((4.0, 6.5), (4.0, 5.0))}


def drawn(keyscans, poses, config=CONFIG, senders=None):
    robots = {keyscan.id.robot for keyscan in keyscans}
    senders = senders or dict(zip(robots, robots, strict=True))
    return fuse(keyscans, poses, dict.fromkeys(robots, (LASER,)), config, senders)


def occupied(occupancy):
    """Centres of the occupied cells, shape (N, 2)."""
    rows, columns = np.nonzero(occupancy.cells == Occupancy.OCCUPIED)
    return np.array(occupancy.origin_xy) + occupancy.resolution_m * (np.stack((columns, rows), axis=-1) + 0.5)


def occupied_near(occupancy, ways, radius_m=RADIUS_M + 0.05):
    cells = occupied(occupancy)
    near = [np.hypot(*(cells - pose[:2]).T) <= radius_m for way in ways for pose in way]
    return int(np.any(near, axis=0).sum())


def test_robots_that_meet_leave_no_ghosts():
    # c stands at its end while others still look at it
    ways = {**MEETING, "c": np.concatenate((MEETING["c"][:5], np.repeat(MEETING["c"][4:5], 20, axis=0)))}
    keyscans, poses = drive(ways)
    keyscans, poses = zip(*[
        (keyscan, pose) for keyscan, pose in zip(keyscans, poses, strict=True)
        if keyscan.id.robot != "c" or keyscan.id.number < 5
    ], strict=True)  # fmt: skip
    poses = np.array(poses)
    assert occupied_near(drawn(keyscans, poses), ways.values()) == 0
    with_ghosts = drawn(keyscans, poses, CONFIG.model_copy(update={"robot_radius_m": 0.0}))
    assert occupied_near(with_ghosts, ways.values()) > 0, "or the test shows nothing"


def walls(occupancy):
    """Occupied cells along the walls of the room."""
    return {
        tuple(cell)
        for cell in np.round(occupied(occupancy), 3).tolist()
        if min(*cell, *(SIDE_M - np.array(cell))) < 0.06
    }


def test_a_robot_that_says_it_is_at_the_walls_hides_none_of_them():
    keyscans, poses = drive(MEETING)
    honest = walls(drawn(keyscans, poses))
    on_wall = line((1.0, 8.0), (7.0, 8.0))
    lies = [
        replace(keyscan, ranges_m=np.full(BEAMS, 19.0, np.float32)) if keyscan.id.robot == "b" else keyscan
        for keyscan in keyscans
    ]
    poses = np.array([
        on_wall[keyscan.id.number] if keyscan.id.robot == "b" else pose
        for keyscan, pose in zip(lies, poses, strict=True)
    ])  # fmt: skip
    masked = walls(drawn(lies, poses))
    unmasked = walls(drawn(lies, poses, CONFIG.model_copy(update={"robot_radius_m": 0.0})))
    assert masked == unmasked, "its pose takes no point of a wall out of the scans of others"
    assert len(honest) > 300


def test_a_robot_that_says_it_is_elsewhere_is_seen_where_it_stands():
    """b stands still in the middle, and says it drives along: it does not hide."""
    stands = {**MEETING, "b": np.repeat(MEETING["b"][12:13], 25, axis=0)}
    keyscans, poses = drive(stands, claimed={"b": line((1.0, 7.0), (7.0, 7.0))})
    keyscans = [
        replace(keyscan, ranges_m=np.zeros(BEAMS, np.float32)) if keyscan.id.robot == "b" else keyscan
        for keyscan in keyscans
    ]
    assert occupied_near(drawn(keyscans, poses), [stands["b"][:1]]) > 3


def test_sessions_of_one_robot_and_of_robots_that_never_meet_are_drawn_as_ever():
    keyscans, poses = drive({"a": MEETING["a"], "b": line((6.0, 7.5), (2.0, 7.5))})
    whole = drawn(keyscans, poses, CONFIG.model_copy(update={"robot_radius_m": 0.0}))
    same = drawn(keyscans, poses, senders={"a": "a", "b": "a"})
    assert np.array_equal(same.cells, whole.cells)


@pytest.mark.parametrize("clock_s", [0.0, 1e9])
def test_clocks_that_disagree_hide_no_wall(clock_s):
    keyscans, poses = drive(MEETING)
    other = [
        replace(keyscan, stamp=keyscan.stamp + clock_s) if keyscan.id.robot == "a" else keyscan for keyscan in keyscans
    ]
    assert walls(drawn(other, poses)) >= walls(drawn(keyscans, poses))
