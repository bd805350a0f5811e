"""A 3D LiDAR that turns in a made-up building: floors, walls and boxes, all parallel to the axes."""

from collections.abc import Callable, Iterator

import numpy as np

from fcslam.geometry import se2, se3
from fcslam.records import CloudScan

Boxes = np.ndarray
"""Low and high corners, shape (M, 2, 3), metres."""
ORIGIN = np.array([0.1, 0.0, 0.6])
PERIOD_S = 0.1


def room(seed: int, size: tuple[float, float] = (12.0, 8.0)) -> Boxes:
    """A room from (0, 0) on with furniture along its walls."""
    generator, (x, y) = np.random.default_rng(seed), size
    walls = [
        ((-1, -1, -0.2), (x + 1, y + 1, 0)),
        ((-1, -1, 3), (x + 1, y + 1, 3.2)),
        ((-0.2, -1, 0), (0, y + 1, 3)),
        ((x, -1, 0), (x + 0.2, y + 1, 3)),
        ((-1, -0.2, 0), (x + 1, 0, 3)),
        ((-1, y, 0), (x + 1, y + 0.2, 3)),
    ]
    for _ in range(8):
        cx, side = generator.uniform(0.5, x - 0.5), generator.integers(2)
        w, depth, height = generator.uniform(0.3, 0.8), generator.uniform(0.3, 1.2), generator.uniform(0.4, 2.2)
        low = 0.0 if side else y - depth
        walls.append(((cx - w, low, 0), (cx + w, low + depth, height)))
    return np.array(walls, float)


def cast(boxes: Boxes, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance along each ray (N, 3) to the nearest box, shape (N,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (boxes[None, :, 0] - origins[:, None]) / rays[:, None]
        b = (boxes[None, :, 1] - origins[:, None]) / rays[:, None]
    near, far = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
    hit = (near < far) & (near > 0.0)
    return np.where(hit, near, np.inf).min(axis=1)


def drive(
    boxes: Boxes,
    pose_at: Callable[[float], np.ndarray],
    turns: int,
    *,
    azimuths: int = 180,
    wheels: bool = True,
    gyro: bool = False,
    scale: float = 1.0,
    bias: float = 0.02,
    noise_m: float = 0.01,
    seed: int = 0,
) -> Iterator[tuple[CloudScan, np.ndarray]]:
    """Turns of a LiDAR with 16 rings on a robot at ``pose_at(t)`` in the plane, with the true pose (7,) at each stamp.

    The wheels measure all motion ``scale`` times as large, and the gyro has a ``bias`` about the vertical.
    """
    generator = np.random.default_rng(seed)
    rings = np.radians(np.linspace(-15.0, 15.0, 16))
    for number in range(turns):
        stamp = number * PERIOD_S
        times = stamp + PERIOD_S * np.arange(azimuths) / azimuths
        poses = se3.from_plane(np.array([pose_at(t) for t in times]))
        angles = np.pi - 2.0 * np.pi * np.arange(azimuths) / azimuths
        rays = np.stack(
            (
                np.cos(rings) * np.cos(angles)[:, None],
                np.cos(rings) * np.sin(angles)[:, None],
                np.broadcast_to(np.sin(rings), (azimuths, 16)),
            ),
            axis=-1,
        )
        turned = rays @ np.swapaxes(se3.rotation(poses), -1, -2)
        origins = np.repeat(se3.transform(poses, np.broadcast_to(ORIGIN, (azimuths, 1, 3))), 16, axis=1)
        distances = cast(boxes, origins.reshape(-1, 3), turned.reshape(-1, 3))
        distances += generator.normal(0.0, noise_m, len(distances))
        seen = distances < 30.0
        points = rays.reshape(-1, 3)[seen] * distances[seen, None] + ORIGIN
        readings = stamp + np.arange(-2, 12) * 0.01 if number else np.arange(12) * 0.01
        readings = readings[(readings >= 0.0) & ((readings > stamp + 0.015) | (number == 0))]
        path = np.array([pose_at(t) for t in readings])
        measured = np.column_stack((readings, scale * path))
        rate = np.array([se2.motion(pose_at(t - 1e-3), pose_at(t + 1e-3))[2] / 2e-3 for t in readings]) + bias
        imu = np.zeros((len(readings), 7))
        imu[:, 0], imu[:, 3], imu[:, 6] = readings, rate, 9.81
        yield (
            CloudScan(
                stamp,
                points.astype(np.float32),
                np.repeat(times - stamp, 16)[seen].astype(np.float32),
                ORIGIN,
                measured if wheels else np.zeros((0, 4)),
                imu if gyro else np.zeros((0, 7)),
            ),
            poses[0],
        )


def circle(middle: tuple[float, float], radius_m: float, rate_rad_s: float) -> Callable[[float], np.ndarray]:
    """A drive along a circle."""

    def pose_at(t: float) -> np.ndarray:
        angle = rate_rad_s * t
        return np.array([middle[0] + radius_m * np.cos(angle), middle[1] + radius_m * np.sin(angle), angle + np.pi / 2])

    return pose_at
