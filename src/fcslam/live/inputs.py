"""Makes records of what a user's program feeds into a live robot. An ``InputError`` says what cannot be used."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from fcslam.cloud.sessions import check_robot
from fcslam.errors import InputError, PacketError
from fcslam.geometry.beams import is_field_of_view, misfit, spread
from fcslam.records import CameraImage, CameraModel, FloatArray, LaserModel, LaserScan, frozen
from fcslam.runs import check_names
from fcslam.sources.gate import MAX_STEP_BACK_S

Lasers = LaserModel | Mapping[str, LaserModel]


def checked_robot(name: str) -> str:
    """The name of a robot."""
    try:
        check_robot(name)
    except PacketError as error:
        raise InputError(f"{error}; give the robot another name") from error
    check_names([name])
    return name


def checked_lasers(lasers: Lasers | None) -> dict[str, LaserModel]:
    """The lasers by name; the name of the only one is empty."""
    if lasers is None:
        return {}
    named = dict(lasers) if isinstance(lasers, Mapping) else {"": lasers}
    for name, laser in named.items():
        numbers = laser.angle_min_rad, laser.angle_increment_rad, laser.max_range_m, *laser.T_base_laser
        where = f"laser {name!r}" if name else "laser"
        if not all(map(math.isfinite, numbers)) or laser.max_range_m <= 0.0:
            raise InputError(f"{where}: {laser} needs finite numbers and a max_range_m above 0 metres")
        if not is_field_of_view(laser.beams):
            raise InputError(
                f"{where}: {laser.beam_count} beams that are {math.degrees(laser.angle_increment_rad):.4g} degrees "
                "apart are not of one turn; check beam_count and angle_increment_rad, which is in radians"
            )
    if len(set(named.values())) < len(named):
        raise InputError("two lasers have the same beams and the same T_base_laser; give each its own mounting")
    return named


def checked_scan(ranges_m: ArrayLike, stamp: float, T_odom_base: FloatArray, laser: LaserModel) -> LaserScan:
    """A scan as a record; negative ranges are made invalid. The stamp and the pose were checked before.

    The ranges have shape (N,); N may vary from scan to scan, the field of view does not.
    """
    try:
        ranges = np.array(ranges_m, np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(f"ranges_m: not an array of numbers ({error})") from error
    beams = laser.beams
    if ranges.shape != (laser.beam_count,):
        is_row = ranges.ndim == 1 and len(ranges) >= 2
        beams = spread(len(ranges), laser.beams) if is_row else beams
        if not is_row or misfit(beams, laser.beams) is not None:
            raise InputError(
                f"ranges_m: shape {ranges.shape}, but the laser has about {laser.beam_count} beams; give one range for "
                "each"
            )
    ranges[ranges < 0.0] = np.nan
    return LaserScan(stamp, frozen(ranges, np.float32), laser.with_beams(beams), T_odom_base)


def checked_camera(camera: CameraModel | None) -> CameraModel | None:
    """The camera."""
    if camera is None:
        return None
    translation_m, rotation = camera.T_base_camera
    numbers = camera.fx, camera.fy, camera.cx, camera.cy, *translation_m, *rotation
    is_unit = math.isclose(math.hypot(*rotation), 1.0, abs_tol=1e-3)
    if not all(map(math.isfinite, numbers)) or min(camera.fx, camera.fy, camera.width, camera.height) <= 0:
        raise InputError(f"camera: {camera} needs finite numbers, and a size and a focal length above 0 pixels")
    if not is_unit:
        raise InputError(f"camera: the rotation {rotation} of T_base_camera is not a unit quaternion (x, y, z, w)")
    return camera


def checked_image(image: ArrayLike, stamp: float, T_odom_base: FloatArray | None, camera: CameraModel) -> CameraImage:
    """An image as a record, encoded as JPEG: grey values are enough for keypoints. The rest was checked before.

    The image has shape (height, width), or (height, width, 3) in the order red, green, blue; uint8.
    """
    import cv2

    pixels = np.asarray(image)
    size = camera.height, camera.width
    if pixels.dtype != np.uint8 or pixels.shape not in (size, (*size, 3)):
        raise InputError(
            f"image: shape {pixels.shape} of {pixels.dtype}, but the camera gives {size} or {(*size, 3)} of uint8"
        )
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    _, encoded = cv2.imencode(".jpg", grey)
    return CameraImage(stamp, encoded.tobytes(), camera, T_odom_base)


def checked_stamp(stamp: float, newest_s: float) -> float:
    """A stamp, seconds."""
    try:
        is_time = math.isfinite(stamp)
    except TypeError:
        is_time = False
    if not is_time:
        raise InputError(f"stamp: {stamp} is not a time; give seconds")
    if stamp < newest_s - MAX_STEP_BACK_S:
        raise InputError(
            f"stamp: {stamp:.6f} s is {newest_s - stamp:.3g} s before the newest scan; the clock went back. Stamps may "
            f"step back by {MAX_STEP_BACK_S:g} s at most; after a change of the clock, make a new Robot"
        )
    return float(stamp)
