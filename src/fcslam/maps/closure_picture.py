"""The picture of a closure: the walls that two robots saw, laid on each other."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.maps import palette
from fcslam.records import FloatArray

SIDE_PX: Final = 480
REACH_M: Final = 15.0
"""Half of the side: returns farther than this from the first keyscan are left out."""
DOT_PX: Final = 2


def closure_png(points: tuple[FloatArray, FloatArray], poses: tuple[FloatArray, FloatArray]) -> bytes:
    """Draw returns of both ends of a closure as a PNG.

    Args:
        points: returns of each end in the base of the first end's keyscan, shape (N, 2), metres.
        poses: poses (x, y, theta) of both ends' keyscans there, shape (3,), metres and radians.
    """
    canvas = np.full((SIDE_PX, SIDE_PX, 3), _bgr(palette.FLOOR), np.uint8)
    for returns, pose, color in zip(points, poses, map(_bgr, palette.ROBOTS), strict=False):
        for column, row in _pixels(returns):
            cv2.circle(canvas, (int(column), int(row)), DOT_PX, color, cv2.FILLED, cv2.LINE_AA)
        arrow = se2.transform(pose, np.array(((0.0, 0.0), (1.0, 0.0))))
        if len(ends := _pixels(arrow)) == 2:
            start, end = ends.tolist()
            cv2.arrowedLine(canvas, start, end, _bgr(palette.WALL), 5, cv2.LINE_AA, 0, 0.4)
            cv2.arrowedLine(canvas, start, end, color, 3, cv2.LINE_AA, 0, 0.4)
    return bytes(cv2.imencode(".png", canvas)[1])


def _pixels(points: FloatArray) -> NDArray[np.int64]:
    """Column and row of the points in the picture, shape (M, 2)."""
    inside = points[(np.abs(points) < REACH_M).all(axis=1)]
    return np.asarray(np.rint((inside * (1.0, -1.0) + REACH_M) * ((SIDE_PX - 1) / (2.0 * REACH_M))).astype(np.int64))


def _bgr(rgb: int) -> tuple[int, int, int]:
    return rgb & 255, rgb >> 8 & 255, rgb >> 16
