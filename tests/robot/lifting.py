"""Drives that wait in a closed cabin, and leave it on the same floor or, as of a lift, on another one."""

from functools import lru_cache

import numpy as np

from fcslam.metrics.trajectory import align, position_errors
from fcslam.records import LaserScan, frozen
from tests.lidar.worlds import LASER, box, drifting, drive, path, ranges

LENGTH_M = 12.0
CABIN, DOOR = path((0, 0.5), (0, 0.8), (-1.8, 0.8), (-1.8, -0.8), (0, -0.8), (0, -0.5)), path((0, -0.5), (0, 0.5))
INSIDE = -0.9, 0.0


@lru_cache
def storey(seed):
    """Walls (S, 4) of a corridor with rooms, from the cabin's door on, and the middles of the rooms' doors."""
    rng, doors = np.random.default_rng(seed), []
    walls = [path((0, -1), (0, -0.5)), path((0, 0.5), (0, 1)), path((LENGTH_M, -1), (LENGTH_M, 1))]
    for side in (-1, 1):
        x = 0.0
        while x < LENGTH_M:
            end = x + rng.uniform(3.0, 4.5)
            end = LENGTH_M if end > LENGTH_M - 2.5 else end
            door, depth = rng.uniform(x + 0.3, end - 1.3), rng.uniform(3.0, 5.5)
            far = side * (1 + depth)
            walls += [path((x, side), (door, side)), path((door + 1, side), (end, side))]
            walls += [path((x, side), (x, far), (end, far), (end, side))]
            left, wide = rng.uniform(x, end - 1.0), rng.uniform(0.4, 1.0)
            walls.append(box(left, far - side * rng.uniform(0.3, 0.8), left + wide, far))
            doors.append((door + 0.5, side))
            x = end
    return np.vstack(walls), sorted(doors)


def ride(*seeds, closed_s=8.0, laser=LASER, odometry=True, change=None, seed=0):
    """A drive through storeys by way of the cabin, which is closed for some seconds between two of them.

    ``change(walls)`` changes what the robot finds after the cabin. Returns the scans, their true poses (N, 3), and the
    stamps of the first scan after each closed door.
    """
    rng = np.random.default_rng(seed)
    parts, truth, openings = [], [], []
    for number, each in enumerate(seeds):
        walls, doors = storey(each)
        walls = walls if change is None or number == 0 else change(walls)
        stops = [(x, y) for x, side in doors for x, y in ((x, 0.0), (x, 2.2 * side), (x, 0.0))]
        is_last = number == len(seeds) - 1
        poses = drive([*([INSIDE] if number else []), (1.0, 0.0), *stops, *([] if is_last else [(1.0, 0.0), INSIDE])])
        parts.append((poses, np.vstack((walls, CABIN))))
        if not is_last:
            x, y, heading = poses[-1]
            turned = [(x, y, heading + 0.2 * k) for k in range(16)]
            waiting = np.array([*turned, *[turned[-1]] * round(5.0 * closed_s - 16)])
            parts.append((waiting, np.vstack((CABIN, DOOR))))
    seen = np.concatenate([ranges(poses, walls, laser, 0.01, rng) for poses, walls in parts])
    truth = np.concatenate([poses for poses, _ in parts])
    odom = drifting(truth, rng) if odometry else np.full((len(truth), 3), np.nan)
    scans = [
        LaserScan(100.0 + 0.2 * k, frozen(row, np.float32), laser, frozen(pose))
        for k, (row, pose) in enumerate(zip(seen, odom, strict=True))
    ]
    ends = np.cumsum([len(poses) for poses, _ in parts])
    openings = [scans[end].stamp for end in ends[1:-1:2]]
    return scans, truth, openings


def errors_m(track, truth):
    """Distances (N,) of the poses of a session from the truth (N, 3), after one rigid alignment."""
    found = track.T_odom_base()
    return position_errors(align(truth, found), truth, found)
