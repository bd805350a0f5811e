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
"""Half of the side, or more for keyscans that are far apart: this remains around each."""
DOT_PX: Final = 2


def closure_png(
    points: tuple[FloatArray, FloatArray], poses: tuple[FloatArray, FloatArray], colors: tuple[int, int]
) -> bytes:
    """Draw returns of both ends of a closure as a PNG.

    Args:
        points: returns of each end in the base of the first end's keyscan, shape (N, 2), metres.
        poses: poses (x, y, theta) of both ends' keyscans there, shape (3,), metres and radians.
        colors: of both ends, as in ``palette``.
    """
    canvas = np.full((SIDE_PX, SIDE_PX, 3), _bgr(palette.FLOOR), np.uint8)
    centre = (poses[0][:2] + poses[1][:2]) / 2.0
    reach_m = REACH_M + float(np.abs(poses[0][:2] - centre).max())
    for returns, pose, color in zip(points, poses, map(_bgr, colors), strict=True):
        for column, row in _pixels(returns - centre, reach_m):
            cv2.circle(canvas, (int(column), int(row)), DOT_PX, color, cv2.FILLED, cv2.LINE_AA)
        arrow = se2.transform(pose, np.array(((0.0, 0.0), (1.0, 0.0))))
        start, end = _pixels(arrow - centre, reach_m).tolist()
        cv2.arrowedLine(canvas, start, end, _bgr(palette.WALL), 5, cv2.LINE_AA, 0, 0.4)
        cv2.arrowedLine(canvas, start, end, color, 3, cv2.LINE_AA, 0, 0.4)
    return bytes(cv2.imencode(".png", canvas)[1])


def _pixels(points: FloatArray, reach_m: float) -> NDArray[np.int64]:
    """Column and row of the points in the picture, shape (M, 2)."""
    inside = points[(np.abs(points) < reach_m).all(axis=1)]
    return np.asarray(np.rint((inside * (1.0, -1.0) + reach_m) * ((SIDE_PX - 1) / (2.0 * reach_m))).astype(np.int64))


def _bgr(rgb: int) -> tuple[int, int, int]:
    return rgb & 255, rgb >> 8 & 255, rgb >> 16
