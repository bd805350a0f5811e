"""Tags in camera images: where they are in the robot's base. The images stay on the robot."""

from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.detector import GreyImage, decode_grey
from fcslam.geometry import se2
from fcslam.records import CameraImage, CameraModel, FloatArray, KeyscanId, Tag, TagFamily, TagSighting, frozen

EDGE_SIGMA_PX, CORNER_SIGMA_PX = 0.3, 1.5
"""Standard deviation of a corner where fitted edges meet, and of one refined by itself."""
MARGIN_PX: Final = 30
"""The part of an image around its tags in which edges are fitted extends farther by this."""
TILT_SIGMA_RAD: Final = 0.05
"""Standard deviation of the tilt of a wall's tag, and of the robot."""
MOST_TILT: Final = 0.5
"""A tag whose normal is farther off the horizontal and the vertical than by this sine has no heading in the plane."""
LARGEST_CHI2: Final = 30.0
"""A square whose corners fit worse is not a tag."""
AMBIGUITY_CHI2: Final = 12.0
"""A square seen head-on has two poses that fit about as well. A pose counts if the other one costs this much more."""
POSITION_SIGMA: Final = (0.01, 0.01)
"""Standard deviation of a position besides that of the corners: metres, and metres for each metre of distance."""
HEADING_SIGMA_RAD: Final = 0.02
"""Standard deviation of a heading besides that of the corners."""
LARGEST_SIGMAS: Final = np.array((0.5, 0.5, 0.25))
"""A pose with a larger standard deviation, in metres and radians, is not sent."""
WORST_CONDITION: Final = 1e12


class TagsConfig(Settings):
    """Tags that the camera looks for."""

    family: TagFamily = Field(
        default=TagFamily.APRILTAG_36H11,
        description="family of the tags: a dictionary of OpenCV without DICT_, as apriltag_36h11 or 4x4_50",
    )
    size_m: float | None = Field(
        default=None, gt=0.0, description="side of the black square of a tag; null: nothing looks for tags [m]"
    )


class TagDetector:
    """Finds the tags of one family and size."""

    def __init__(self, config: TagsConfig) -> None:
        assert config.size_m is not None, "without a size there are no poses"
        self._family = config.family
        self._square = 0.5 * config.size_m * np.array([(-1, 1, 0), (1, 1, 0), (1, -1, 0), (-1, -1, 0)], np.float64)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{config.family.upper()}"))
        self._detectors = []
        for refinement in (cv2.aruco.CORNER_REFINE_SUBPIX, cv2.aruco.CORNER_REFINE_APRILTAG):
            parameters = cv2.aruco.DetectorParameters()
            parameters.cornerRefinementMethod = refinement
            self._detectors.append(cv2.aruco.ArucoDetector(dictionary, parameters))

    def find(self, image: CameraImage, keyscan: KeyscanId, T_keyscan_image: FloatArray) -> Iterator[TagSighting]:
        """The tags of an image whose pose is unambiguous, each number at most once.

        ``T_keyscan_image`` is the pose of the base at the time of the image in the keyscan's base, shape (3,).
        """
        picture = decode_grey(image.encoded)
        if picture is None or picture.shape != (image.camera.height, image.camera.width):
            return
        # The second one fits edges: several times as accurate, several times as slow, and it misses small tags.
        quick, thorough = self._detectors
        found = [(number, corners, CORNER_SIGMA_PX) for number, corners in _detected(quick, picture)]
        if found:
            seen = np.concatenate([corners for _, corners, _ in found])
            low = np.maximum(seen.min(axis=0) - MARGIN_PX, 0).astype(int)
            column, row = np.minimum(seen.max(axis=0) + MARGIN_PX, picture.shape[::-1]).astype(int)
            part = np.ascontiguousarray(picture[low[1] : row, low[0] : column])
            precise = {number: (corners + low, EDGE_SIGMA_PX) for number, corners in _detected(thorough, part)}
            found = [(number, *precise.get(number, others)) for number, *others in found]
        numbers = [number for number, *_ in found]
        for number, corners, sigma_px in found:
            measured = tag_in_base(corners, sigma_px, self._square, image.camera)
            if measured is None or numbers.count(number) > 1:
                continue
            T_base_tag, information = measured
            T_keyscan_tag: FloatArray = frozen(se2.compose(T_keyscan_image, T_base_tag))
            yield TagSighting(keyscan, Tag(self._family, number), T_keyscan_tag, frozen(information))


def _detected(detector: cv2.aruco.ArucoDetector, picture: GreyImage) -> list[tuple[int, FloatArray]]:
    quads, numbers, _ = detector.detectMarkers(picture)
    found = [] if numbers is None else numbers.ravel().tolist()
    return [(number, np.asarray(quad, np.float64).reshape(4, 2)) for number, quad in zip(found, quads, strict=True)]


def tag_in_base(
    corners: FloatArray, sigma_px: float, square: FloatArray, camera: CameraModel
) -> tuple[FloatArray, FloatArray] | None:
    """Pose of a tag in the plane of the base, and its information; None if it is ambiguous or no pose fits.

    Args:
        corners: in the image, shape (4, 2), pixels.
        sigma_px: their standard deviation.
        square: the same corners on the tag, shape (4, 3), metres: x to the right, y up, z towards the viewer.
        camera: its calibration and mounting.
    """
    from scipy.optimize import approx_fprime, least_squares  # most images show no tag

    matrix = np.array(((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0)))
    R_base_camera = camera.T_base_camera.rotation_matrix()
    offset = np.array(camera.T_base_camera.translation_m)

    def normal(pose: FloatArray) -> FloatArray:
        axis: FloatArray = R_base_camera @ cv2.Rodrigues(pose[:3])[0][:, 2]
        return axis

    def residuals(pose: FloatArray) -> FloatArray:
        seen = cv2.projectPoints(square, pose[:3], pose[3:], matrix, None)[0].reshape(4, 2)
        tilt = normal(pose)[2]
        steep = tilt if abs(tilt) < MOST_TILT else np.hypot(*normal(pose)[:2])
        return np.append(((seen - corners) / sigma_px).ravel(), steep / TILT_SIGMA_RAD)

    def in_plane(pose: FloatArray) -> FloatArray:
        turn = R_base_camera @ cv2.Rodrigues(pose[:3])[0]
        axis = turn[:, 2] if abs(turn[2, 2]) < MOST_TILT else turn[:, 0]
        position = R_base_camera @ pose[3:] + offset
        return np.array((position[0], position[1], np.arctan2(axis[1], axis[0])))

    guesses = _two_poses(square, corners, matrix)
    fitted = sorted((least_squares(residuals, guess, method="lm") for guess in guesses), key=lambda fit: fit.cost)
    if not fitted or not 2.0 * fitted[0].cost <= LARGEST_CHI2:  # false for NaN
        return None
    best = fitted[0].x
    T_base_tag = in_plane(best)
    for other in fitted[1:]:
        is_other = abs(se2.wrap_angle(in_plane(other.x)[2] - T_base_tag[2])) > HEADING_SIGMA_RAD
        if is_other and 2.0 * (other.cost - fitted[0].cost) < AMBIGUITY_CHI2:
            return None
    if best[5] <= 0.0 or MOST_TILT <= abs(normal(best)[2]) <= np.sqrt(1.0 - MOST_TILT**2):
        return None
    jacobian: FloatArray = np.array(fitted[0].jac)
    hessian, projection = jacobian.T @ jacobian, approx_fprime(best, in_plane)
    if not np.linalg.cond(hessian) < WORST_CONDITION:
        return None
    covariance = projection @ np.linalg.inv(hessian) @ projection.T
    fixed, relative = POSITION_SIGMA
    sigma_m = np.hypot(fixed, relative * np.linalg.norm(best[3:]))
    covariance += np.diag((sigma_m**2, sigma_m**2, HEADING_SIGMA_RAD**2))
    if not (covariance.diagonal() < LARGEST_SIGMAS**2).all():  # so that NaN fails, too
        return None
    turn = se2.adjoint((0.0, 0.0, T_base_tag[2]))
    information = turn.T @ np.linalg.inv(covariance) @ turn
    return T_base_tag, 0.5 * (information + information.T)


def _two_poses(square: FloatArray, corners: FloatArray, matrix: FloatArray) -> list[FloatArray]:
    """The poses of the tag in the camera that a square leaves open: rotation vector and translation, shape (6,)."""
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(square, corners, matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    except cv2.error:
        return []
    poses = [np.append(turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
    return [pose for pose in poses if np.isfinite(pose).all()]
