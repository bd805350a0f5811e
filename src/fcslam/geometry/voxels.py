"""Voxels of voxel maps: one point in each, in steps, within fixed bounds. All maps of a fleet use the same."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.records import STEP_M, Steps

VOXEL_STEPS: Final = 5
"""Side of a voxel in steps: 0.1 m."""
LOWEST, END = (-128, -128, -64), (128, 128, 192)
"""The lowest voxel and the end of the highest one: 12.8 m around, from 6.4 m below to 19.2 m above."""
MOST_POINTS: Final = 32768


def are_inside(steps: NDArray[np.int64] | Steps) -> bool:
    """Whether points (N, 3) are within the bounds."""
    low, high = (VOXEL_STEPS * np.array(corner) for corner in (LOWEST, END))
    return bool(((steps >= low) & (steps < high)).all())


def voxel_keys(points: NDArray[np.int64] | Steps) -> NDArray[np.int64]:
    """Number of the voxel of each point (N, 3), shape (N,): ascending by x, then y, then z; below 2^24."""
    keys: NDArray[np.int64] = (points.astype(np.int64) // VOXEL_STEPS - LOWEST) @ (1 << 16, 1 << 8, 1)
    return keys


def voxelised(
    points_m: NDArray[np.float64], scans: NDArray[np.int64], origins_m: NDArray[np.float64]
) -> tuple[Steps, NDArray[np.uint8]]:
    """The middle of the points (N, 3), metres, in each voxel, and the scan that saw it.

    ``scans`` (N,): of each point, as a row of ``origins_m`` (M, 3), where the scanner was. The nearest of several scans
    counts. Voxels ascend, without those outside; the nearest ``MOST_POINTS`` are kept.
    """
    low, high = (VOXEL_STEPS * STEP_M * np.array(corner) for corner in (LOWEST, END))
    kept = ((points_m >= low) & (points_m < high)).all(axis=1)
    inside, scans = points_m[kept], scans[kept]
    voxels = np.floor(inside / (VOXEL_STEPS * STEP_M)).astype(np.int64)
    unique, number, counts = np.unique(voxel_keys(VOXEL_STEPS * voxels), return_inverse=True, return_counts=True)
    middle = np.column_stack([np.bincount(number, axis) for axis in inside.T]) / counts[:, None]
    first = np.zeros((len(unique), 3), np.int64)
    first[number] = VOXEL_STEPS * voxels  # a middle that rounds into the next voxel stays in its own
    steps = np.clip(np.rint(middle / STEP_M).astype(np.int64), first, first + VOXEL_STEPS - 1)
    farthest_first = np.argsort(-((inside - origins_m[scans]) ** 2).sum(axis=1), kind="stable")
    seen_from = np.zeros(len(unique), np.uint8)
    seen_from[number[farthest_first]] = scans[farthest_first]
    if len(steps) > MOST_POINTS:
        nearest = np.sort(np.argsort((steps**2).sum(axis=1), kind="stable")[:MOST_POINTS])
        steps, seen_from = steps[nearest], seen_from[nearest]
    return steps.astype(np.int16), seen_from


def to_steps(origins_m: NDArray[np.float64]) -> Steps:
    """Positions (M, 3), metres, in steps."""
    return np.asarray(np.rint(origins_m / STEP_M), np.int16)
