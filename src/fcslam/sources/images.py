"""Checks of encoded images without decoding: file type and size."""

from io import BytesIO

from fcslam.records import CameraModel

MAX_IMAGE_BYTES = 1 << 25
MAX_SIDE_PX = 1 << 14

_FAR = 1e6
"""Bound of intrinsics in pixels and of positions in metres."""
_UNIT = 1e-6
"""Largest deviation of a quaternion's squared length from 1."""
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


def image_suffix(encoded: bytes) -> str:
    """``jpg`` or ``png`` by the first bytes; raises ValueError for anything else."""
    if encoded.startswith(_JPEG):
        return "jpg"
    if encoded.startswith(_PNG):
        return "png"
    raise ValueError("neither JPEG nor PNG")


def image_size(encoded: bytes) -> tuple[int, int]:
    """Width and height in pixels from the header; raises ValueError if there is none of a JPEG or PNG file."""
    from PIL import Image

    try:
        with Image.open(BytesIO(encoded), formats=("JPEG", "PNG")) as image:
            return image.size
    except Exception as error:  # Pillow's formats raise errors of many types
        raise ValueError("the header is not that of a JPEG or PNG file") from error


def check_image(encoded: bytes, camera: CameraModel) -> None:
    """Raises ValueError if ``encoded`` is not an image of ``camera``."""
    if len(encoded) > MAX_IMAGE_BYTES:
        raise ValueError(f"an image has at most {MAX_IMAGE_BYTES} bytes")
    width, height = image_size(encoded)
    if (width, height) != (camera.width, camera.height):
        raise ValueError(f"the image has {width} x {height} pixels, its camera {camera.width} x {camera.height}")


def check_camera(camera: CameraModel) -> None:
    """Raises ValueError if ``camera`` is invalid."""
    if not (0 < camera.width <= MAX_SIDE_PX and 0 < camera.height <= MAX_SIDE_PX):
        raise ValueError(f"width and height must be 1 to {MAX_SIDE_PX} pixels")
    if not (0.0 < camera.fx < _FAR and 0.0 < camera.fy < _FAR):
        raise ValueError("fx and fy must be positive numbers of pixels")
    if not (abs(camera.cx) < _FAR and abs(camera.cy) < _FAR):
        raise ValueError("cx and cy must be numbers of pixels")
    translation_m, rotation = camera.T_base_camera
    if not all(abs(value) < _FAR for value in translation_m):
        raise ValueError("the camera's position must be finite")
    if not abs(sum(value * value for value in rotation) - 1.0) < _UNIT:
        raise ValueError("the camera's quaternion must have length 1")
