"""Camera messages of a bag: images, as sent or encoded as PNG, and the calibration."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.records import CameraModel
from fcslam.sources.bags.codec import COMPRESSED_IMAGE
from fcslam.sources.bags.messages import header_of
from fcslam.sources.bags.transforms import IDENTITY
from fcslam.untrusted import LimitError, image_size

MAX_IMAGE_BYTES = 1 << 25
MAX_SIDE_PX = 1 << 14
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}
_FASTEST = 1
"""Fastest PNG compression level, because images are compressed while the bag is read."""


class ImageMessage(NamedTuple):
    """sensor_msgs/Image or CompressedImage."""

    stamp: float
    encoded: bytes
    """JPEG or PNG."""


class Calibration(NamedTuple):
    """sensor_msgs/CameraInfo."""

    frame: str
    camera: CameraModel
    """Mounted nowhere yet."""
    is_distorted: bool


def image_of(content: Any, kind: str, bag_time_ns: int) -> ImageMessage:
    """Convert a message of type ``kind``, COMPRESSED_IMAGE or IMAGE; raises ValueError if the image is not read.

    A compressed image is JPEG or PNG as it was sent; one of encoding rgb8, bgr8 or mono8 becomes lossless PNG.
    """
    if kind == COMPRESSED_IMAGE:
        encoded = np.asarray(content.data, dtype=np.uint8).tobytes()
        image_format(encoded)
    else:
        encoded = _encoded_png(content)
    stamp, _ = header_of(content.header, bag_time_ns)
    return ImageMessage(stamp, encoded)


def _encoded_png(content: Any) -> bytes:
    import cv2

    channels = _CHANNELS.get(content.encoding)
    if channels is None:
        raise ValueError("an encoding that is not read")
    pixels = pixel_rows(content, channels).reshape(content.height, content.width, channels)
    if content.encoding == "rgb8":
        pixels = pixels[..., ::-1]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, _FASTEST])
    return bytes(encoded)


def pixel_rows(content: Any, pixel_bytes: int) -> NDArray[np.uint8]:
    """The bytes of the rows of an image, shape (height, width * pixel_bytes)."""
    width, height, step = content.width, content.height, content.step
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and step >= width * pixel_bytes):
        raise ValueError(f"width {width}, height {height} and step {step} do not describe an image")
    data = np.asarray(content.data, dtype=np.uint8)
    if len(data) != step * height:
        raise ValueError("the pixels do not fill the image")
    return np.ascontiguousarray(data.reshape(height, step)[:, : width * pixel_bytes])


def calibration_of(content: Any) -> Calibration:
    """A camera's calibration; raises ValueError if the camera is not calibrated."""
    K = np.asarray(content.k if hasattr(content, "k") else content.K, dtype=np.float64)
    D = np.asarray(content.d if hasattr(content, "d") else content.D, dtype=np.float64)
    _, frame = header_of(content.header, 0)
    fx, cx, fy, cy = (float(K[at]) for at in (0, 2, 4, 5))
    if not (0 < content.width <= MAX_SIDE_PX and 0 < content.height <= MAX_SIDE_PX):
        raise ValueError(f"width and height must be 1 to {MAX_SIDE_PX} pixels")
    if not (fx > 0.0 and fy > 0.0 and np.isfinite(K).all()):
        raise ValueError("fx, fy, cx and cy must be numbers of pixels, the first two positive")
    camera = CameraModel(content.width, content.height, fx, fy, cx, cy, IDENTITY)
    return Calibration(frame, camera, bool(np.any(D)))


def image_format(encoded: bytes) -> str:
    """``jpeg`` or ``png``, by the first bytes; raises ValueError for anything else."""
    if encoded.startswith(_JPEG):
        return "jpeg"
    if encoded.startswith(_PNG):
        return "png"
    raise ValueError("neither JPEG nor PNG")


def check_image(encoded: bytes, camera: CameraModel) -> None:
    """Raises ValueError if ``encoded`` is not an image of ``camera``."""
    if len(encoded) > MAX_IMAGE_BYTES:
        raise ValueError(f"an image has at most {MAX_IMAGE_BYTES} bytes")
    try:
        width, height, _ = image_size(encoded)
    except LimitError as error:
        raise ValueError(str(error)) from error
    if (width, height) != (camera.width, camera.height):
        raise ValueError(f"the image has {width} x {height} pixels, its camera {camera.width} x {camera.height}")
