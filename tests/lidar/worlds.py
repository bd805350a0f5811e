"""Drawn worlds for the LiDAR tests: walls as segments, rays cast against them, drives with drifting odometry."""

from functools import lru_cache
from itertools import accumulate

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.records import LaserModel, LaserScan, frozen
from fcslam.sources.faults import Faults

MAX_RANGE_M = 20.0
LASER = LaserModel(360, -np.pi, np.deg2rad(1.0), MAX_RANGE_M)


def path(*corners, closed=False):
    """Segments (S, 4) of a polygon line through corners."""
    points = np.array([*corners, *corners[:1]] if closed else corners, dtype=float)
    return np.hstack((points[:-1], points[1:]))


def box(x0, y0, x1, y1):
    return path((x0, y0), (x1, y0), (x1, y1), (x0, y1), closed=True)


def shifted(segments, dx, dy):
    return segments + np.array([dx, dy, dx, dy])


def room():
    """A room of 8 m by 6 m that looks different from everywhere: a niche, a slanted corner, two cabinets."""
    return np.vstack(
        (
            path((-4, -3), (4, -3), (4, 1.5), (2.5, 3), (0.5, 3), (0.5, 3.8), (-1, 3.8), (-1, 3), (-4, 3), closed=True),
            box(-3.2, -2.6, -2.2, -2.0),
            box(2.2, -1.0, 2.9, 0.4),
        )
    )


def other_room():
    """About as large as ``room``, but another one."""
    return np.vstack((path((-3, -4), (2, -4), (5, -1), (5, 4), (-3, 2), closed=True), box(1.0, 0.5, 1.8, 2.0)))


def corridor(heading=0.0):
    """Two bare walls 2 m apart, longer than the laser reaches."""
    ends = np.array([(-60, -1), (60, -1), (60, 1), (-60, 1)])
    return se2.transform((0.0, 0.0, heading), ends).reshape(2, 4)


@lru_cache
def ring():
    """A corridor 3 m wide around a block, 16 m by 12 m outside; cabinets and niches tell where one is."""
    rng = np.random.default_rng(5)
    cabinets = []
    for x in (2.0, 4.6, 7.9, 10.2, 13.1):
        width, depth = rng.uniform(0.4, 1.2), rng.uniform(0.2, 0.5)
        cabinets += [box(x, 0, x + width, depth), box(x + rng.uniform(-1, 1), 12 - depth, x + width, 12)]
    for y in (3.6, 5.2, 7.7):
        height, depth = rng.uniform(0.4, 1.0), rng.uniform(0.2, 0.5)
        cabinets += [box(0, y, depth, y + height), box(16 - depth, y + rng.uniform(-0.8, 0.8), 16, y + height)]
    block = path(
        (3, 3), (7, 3), (7, 3.8), (8.2, 3.8), (8.2, 3), (13, 3), (13, 9), (5, 9), (5, 8.2), (3, 8.2), closed=True
    )
    return np.vstack((box(0, 0, 16, 12), block, *cabinets))


def ranges(poses, segments, laser=LASER, noise_m=0.0, rng=None):
    """Ranges (N, B) from the base's poses (N, 3); ``max_range_m`` where a ray meets nothing."""
    rays = se2.compose(np.atleast_2d(poses), laser.T_base_laser)
    # pose by pose: an array of all poses, beams and segments does not fit into the cache
    found = np.stack([cast(ray[:2], ray[2] + laser.angles_rad(), segments) for ray in rays])
    found = np.minimum(found, laser.max_range_m)
    if noise_m:
        found = np.where(found < laser.max_range_m, found + rng.normal(0, noise_m, found.shape), found)
    return np.minimum(found, laser.max_range_m).astype(np.float32)


def cast(origins, angles, segments):
    """Distance of the nearest segment along each ray, from one origin or one for each; infinite where there is none."""
    x, y = np.cos(angles)[:, None], np.sin(angles)[:, None]
    side_x, side_y = (segments[:, 2:] - segments[:, :2]).T
    start_x, start_y = np.moveaxis(segments[:, :2] - np.atleast_2d(origins)[:, None], -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = x * side_y - y * side_x
        along = (start_x * side_y - start_y * side_x) / scale
        share = (start_x * y - start_y * x) / scale
    hit = (along > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, along, np.inf).min(axis=1)


def with_disc(ranges_m, pose, centre, radius_m, laser):
    """The ranges (B,) with a disc in their way, as another robot is."""
    angles = pose[2] + laser.angles_rad()
    rays, apart = np.stack((np.cos(angles), np.sin(angles)), axis=-1), np.asarray(centre) - pose[:2]
    along = rays @ apart
    half = radius_m**2 - (apart @ apart - along**2)
    reached = along - np.sqrt(np.maximum(half, 0.0))
    return np.where((half > 0.0) & (reached > 0.0) & (reached < ranges_m), reached, ranges_m).astype(np.float32)


def scan_at(pose, segments, laser=LASER, noise_m=0.0, rng=None):
    """Points seen from one pose."""
    return point_scan(frozen(ranges(pose, segments, laser, noise_m, rng)[0], np.float32), laser)


def drive(waypoints, step_m=0.1, step_rad=0.1):
    """Poses (N, 3) of a robot that turns at each waypoint and drives straight to the next."""
    points = np.array(waypoints, dtype=float)
    legs = np.diff(points, axis=0)
    headings = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    poses = [np.array([*points[0], headings[0]])]
    for start, leg, heading in zip(points[:-1], legs, headings, strict=True):
        turn = heading - poses[-1][2]
        for k in range(1, int(np.ceil(abs(turn) / step_rad)) + 1):
            poses.append(np.array([*start, heading - turn * (1 - k / np.ceil(abs(turn) / step_rad))]))
        count = int(np.ceil(np.hypot(*leg) / step_m))
        poses += [np.array([*(start + leg * k / count), heading]) for k in range(1, count + 1)]
    result = np.array(poses)
    result[:, 2] = se2.wrap_angle(result[:, 2])
    return result


def drifting(poses, rng, scale=1.02, veer_rad_m=0.01, noise=0.01):
    """Odometry (N, 3) from zero: wrong scale, a constant veer, and chance."""
    motions = se2.relative(poses)
    travel = np.hypot(motions[:, 0], motions[:, 1])
    motions[:, :2] *= scale
    motions[:, 2] += veer_rad_m * travel + noise * np.sqrt(travel) * rng.normal(size=len(travel))
    return chain(motions)


def chain(motions, start=np.zeros(3)):  # noqa: B008 - nobody writes to it
    """Poses (N + 1, 3) of a robot that moves by ``motions`` (N, 3), each relative to the pose before."""
    return np.array(list(accumulate(motions, se2.compose, initial=start)))


def recording(poses, odometry, segments, laser=LASER, *, noise_m=0.015, seed=0):
    """Laser scans of a drive, one each 0.2 s; ``laser``: of all scans, or a function of a scan's number."""
    rng, scans = np.random.default_rng(seed), []
    for k, (pose, by_wheels) in enumerate(zip(poses, odometry, strict=True)):
        own = laser(k) if callable(laser) else laser
        (row,) = ranges(pose, segments, own, noise_m, rng)
        scans.append(LaserScan(100.0 + 0.2 * k, frozen(row, np.float32), own, frozen(by_wheels)))
    return scans


class Recording:
    """Scans in memory as the recording of a robot."""

    faults = Faults({})

    def __init__(self, scans, name="r"):
        self.scans, self.name = scans, name

    def records(self):
        yield from self.scans


def ring_drive(rounds=1.2):
    """Poses of a robot that goes round the ring; 1.2 rounds are 53 m."""
    corners = np.array([(1.5, 1.5), (14.5, 1.4), (14.4, 10.5), (1.6, 10.4)])
    lap = [corners[k % 4] + 0.15 * np.array([np.sin(2.1 * k), np.cos(1.3 * k)]) for k in range(int(4 * rounds) + 2)]
    poses = drive(lap)
    travel = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    return poses[travel <= 44.0 * rounds]


def pose_errors(estimate, truth):
    """Distance (N,) and turn (N,) of poses from the truth, both given relative to their first."""
    rest = se2.between(se2.between(truth[0], truth), se2.between(estimate[0], estimate))
    return np.hypot(rest[:, 0], rest[:, 1]), np.abs(rest[:, 2])


def bare_scan(points: np.ndarray) -> PointScan:
    """Returns seen from the origin of which nothing but the place is known."""
    xy = np.asarray(points, dtype=float).reshape(-1, 2)
    return PointScan(xy, np.zeros_like(xy), np.ones(len(xy), bool), np.zeros(2))
