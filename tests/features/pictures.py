"""Pictures of drawn worlds, without GL: every wall has a pattern of its own, floor and ceiling are plain."""

from functools import lru_cache

import cv2
import numpy as np

from fcslam.geometry import se2
from fcslam.records import CameraImage, CameraModel, Transform, frozen

AHEAD = (-0.5, 0.5, -0.5, 0.5)
"""The rotation of an optical frame that looks along x of the base."""
CAMERA = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5, Transform((0.1, 0.0, 0.6), AHEAD))
WALL_HEIGHT_M = 2.5
TEXELS_PER_M = 16


@lru_cache(maxsize=64)
def pattern(number, length_m):
    """Grey levels of a wall, row 0 at the floor: soft blots, so that nothing depends on single pixels."""
    shape = (round(WALL_HEIGHT_M * TEXELS_PER_M) + 2, round(length_m * TEXELS_PER_M) + 2)
    noise = np.random.default_rng(number).uniform(0, 255, shape).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 1.2) * 3.0 - 255.0


def picture(pose, segments, camera=CAMERA, wears=lambda number: number):
    """Draw the camera's view from the base's pose, shape (height, width): the nearest wall in every column.

    ``wears``: which pattern the wall of a number wears; its own.
    """
    eye = se2.transform(pose, np.array([camera.T_base_camera.translation_m[:2]]))[0]
    side = (np.arange(camera.width) - camera.cx) / camera.fx
    rise = (camera.cy - np.arange(camera.height)) / camera.fy
    ahead, left = np.array([np.cos(pose[2]), np.sin(pose[2])]), np.array([-np.sin(pose[2]), np.cos(pose[2])])
    directions = ahead - side[:, None] * left
    start, along = segments[:, :2] - eye, segments[:, 2:] - segments[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = directions[:, :1] * along[:, 1] - directions[:, 1:] * along[:, 0]
        depth = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / scale
        share = (start[:, 0] * directions[:, 1:] - start[:, 1] * directions[:, :1]) / scale
    depth = np.where((depth > 0) & (share >= 0) & (share <= 1), depth, np.inf)
    wall, columns = depth.argmin(axis=1), np.arange(camera.width)
    nearest, where = depth[columns, wall], share[columns, wall]
    heights = camera.T_base_camera.translation_m[2] + nearest * rise[:, None]
    image = np.where(heights < 0, 60.0, 200.0)
    for number in np.unique(wall[np.isfinite(nearest)]):
        length_m = float(np.hypot(*along[number]))
        seen = (wall == number) & (heights >= 0) & (heights <= WALL_HEIGHT_M)
        u = np.broadcast_to(where * length_m * TEXELS_PER_M, heights.shape).astype(np.float32)
        worn = cv2.remap(
            pattern(wears(int(number)), length_m), u, (heights * TEXELS_PER_M).astype(np.float32), cv2.INTER_LINEAR
        )
        image = np.where(seen, worn, image)
    return np.clip(image, 0, 255).astype(np.uint8)


def image_at(stamp, pose, segments, T_odom_base, wears=lambda number: number):
    """The same as a record."""
    encoded = bytes(cv2.imencode(".jpg", picture(pose, segments, CAMERA, wears))[1])
    return CameraImage(stamp, encoded, CAMERA, frozen(T_odom_base))
