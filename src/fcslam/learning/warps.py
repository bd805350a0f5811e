"""Random homographies and random lighting, which make two views of one image."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.dense import CELL_PX
from fcslam.features.detector import GreyImage
from fcslam.learning.homography import Mask, Size
from fcslam.records import FloatArray

SCALE_SPREAD: Final = 0.7
"""The scales of two views of a pair differ by at most the factor exp of this."""
TILT: Final = 0.12
"""Largest displacement of a corner of a view, as a share of the view's side."""
SMALL_TURN_RAD: Final = 0.2
"""Standard deviation of a view's rotation."""
ANY_TURN_SHARE: Final = 0.1
"""Share of views that are rotated by any angle: robots roll little, but cameras may be mounted at any angle."""
LARGEST_SHIFT_PX: Final = 2 * CELL_PX - 1
"""Largest shift of a pair whose views differ by a shift: it takes a point into any place of a cell of the network."""


def random_view(image: GreyImage, size: Size, rng: np.random.Generator) -> FloatArray:
    """A random window of the image: homography (3, 3) that maps pixels of the image to pixels of the window."""
    whole, wanted = np.array(image.shape[::-1], np.float64), np.array(size, np.float64)
    zoom = min(np.exp(rng.uniform(np.log(0.7), np.log(1.5))), 1.15 * float((whole / wanted).min()))
    x, y = rng.uniform(0.0, np.maximum(whole - zoom * wanted, 0.0))
    return np.array([[1 / zoom, 0.0, -x / zoom], [0.0, 1 / zoom, -y / zoom], [0.0, 0.0, 1.0]])


def random_change(size: Size, rng: np.random.Generator) -> FloatArray:
    """Homography (3, 3) of a view of this size onto itself: rotation, scale, shift and tilt about its centre."""
    sides = np.array(size, np.float64)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (sides - 1.0)
    middle = 0.5 * (sides - 1.0)
    turn = rng.uniform(-np.pi, np.pi) if rng.random() < ANY_TURN_SHARE else rng.normal(0.0, SMALL_TURN_RAD)
    scale = np.exp(rng.uniform(-0.5, 0.5) * SCALE_SPREAD)
    rotation = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    shift = rng.uniform(-0.1, 0.1, 2) * sides
    tilted = corners + rng.uniform(-TILT, TILT, (4, 2)) * sides
    moved = (tilted - middle) @ rotation.T + middle + shift
    homography: FloatArray = cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))
    return homography


def random_shift(rng: np.random.Generator) -> FloatArray:
    """A shift by whole pixels, as homography (3, 3): a network with strides must learn that it changes nothing."""
    x, y = rng.integers(-LARGEST_SHIFT_PX, LARGEST_SHIFT_PX + 1, 2)
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def warp_image(image: GreyImage, homography: FloatArray, size: Size) -> GreyImage:
    """The view of this size, as uint8; beyond its border the image is mirrored, so that the border is not an edge."""
    warped = cv2.warpPerspective(image, homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(warped, np.uint8)


def visible_mask(shape: tuple[int, int], homography: FloatArray, size: Size) -> NDArray[np.bool_]:
    """Which pixels (height, width) of a view show the image of this shape without two pixels at its border."""
    own = np.zeros(shape, np.uint8)
    own[2:-2, 2:-2] = 1
    warped = cv2.warpPerspective(own, homography, size, flags=cv2.INTER_NEAREST)
    return np.asarray(warped, np.bool_)


def well_inside(points: FloatArray, size: Size, border: float) -> Mask:
    """Whether points (N, 2) lie in an image of this size, at least ``border`` pixels from its border; shape (N,)."""
    low, high = border, np.array(size, np.float64) - 1.0 - border
    return np.asarray(((points >= low) & (points <= high)).all(axis=1), np.bool_)


def relight(image: GreyImage, rng: np.random.Generator) -> NDArray[np.float32]:
    """The image with another lighting, lens and sensor, at random: float32 in [0, 1]."""
    changed = image.astype(np.float32) / 255.0
    if rng.random() < 0.5:
        changed = changed ** np.float32(np.exp(rng.uniform(np.log(0.45), np.log(2.2))))
    if rng.random() < 0.3:
        changed = _shade(changed, rng)
    contrast, brightness = np.exp(rng.uniform(np.log(0.35), np.log(1.6))), rng.uniform(-0.2, 0.2)
    changed = (changed - 0.5) * np.float32(contrast) + np.float32(0.5 + brightness)
    if rng.random() < 0.3:
        changed = _blur(changed, rng)
    if rng.random() < 0.8:
        noise = rng.standard_normal(changed.shape, dtype=np.float32)
        changed = changed + np.float32(rng.uniform(0.0, 0.04)) * noise
    changed = np.clip(changed, 0.0, 1.0)
    return _compress(changed, rng) if rng.random() < 0.3 else changed


def _shade(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Add a shadow or a beam of light: an ellipse with soft edges."""
    height, width = image.shape
    mask = np.zeros(image.shape, np.float32)
    centre = (int(rng.integers(width)), int(rng.integers(height)))
    axes = (int(rng.integers(10, 3 * width // 4)), int(rng.integers(10, 3 * height // 4)))
    cv2.ellipse(mask, centre, axes, float(rng.uniform(0, 180)), 0, 360, 1.0, -1)
    mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(1.0, 25.0))), np.float32)
    return image * (1.0 + np.float32(rng.uniform(-0.7, 0.6)) * mask)


def _blur(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Blur as if out of focus, or by motion."""
    if rng.random() < 0.5:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 1.6))), np.float32)
    length, angle = int(rng.integers(2, 4)), rng.uniform(0, np.pi)
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    end = np.rint(length * np.array([np.cos(angle), np.sin(angle)])).astype(int)
    cv2.line(kernel, (length - int(end[0]), length - int(end[1])), (length + int(end[0]), length + int(end[1])), 1.0)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.float32)


def _compress(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    quality = int(rng.integers(30, 95))
    _, encoded = cv2.imencode(".jpg", (255.0 * image).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    return np.asarray(decoded, np.float32) / np.float32(255.0)
