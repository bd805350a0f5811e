"""Reads the maps that Nav2's map_server loads, whatever program wrote them.

The rules are those of ``map_io.cpp`` of Nav2: any image, a grey value of 0 to 255, and

- trinary, scale: the occupancy is 1 - grey / 255, or grey / 255 with ``negate``; pixels that are not opaque are
  unknown;
- raw: the grey value is the occupancy in percent, above 100 unknown; ``negate`` is ignored.

A cell is occupied from ``occupied_thresh`` up, else free up to ``free_thresh``, else unknown. A map that is turned (a
yaw in ``origin``) is drawn again along the axes.
"""

import math
import re
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.config import one_line, parse_yaml
from fcslam.errors import InputError, SourceError
from fcslam.maps.occupancy_map import Cells, Occupancy, OccupancyMap, number_in, read_description
from fcslam.records import frozen
from fcslam.untrusted import MOST_TEXT_BYTES, check_image, read_bytes, read_text

_MODES: Final = ("trinary", "scale", "raw")
_PGM: Final = re.compile(rb"P([25])(?:\s+|#[^\n]*\n)+\d+(?:\s+|#[^\n]*\n)+\d+(?:\s+|#[^\n]*\n)+([1-9]\d{0,4})\s")
_MOST_PIXELS: Final = 1 << 28
"""Largest number of cells of a map that is turned: cells of 2.5 cm over 400 m."""
_ROUNDING: Final = 1e-6
"""Share of a cell by which a map that is turned by a right angle may seem wider."""


def parse_ros_map(name: str, image: bytes, description: str) -> OccupancyMap:
    """Read a map, which messages call ``name``, from its image and its description, whose image is not opened."""
    try:
        return _map(image, description)
    except (OSError, ValueError, cv2.error) as error:
        raise InputError(f"{name}: not a map for ROS map_server: {one_line(str(error))}") from error


def read_ros_map(path: Path) -> OccupancyMap:
    """Read a map from its YAML file and the image that it names."""
    try:
        text = read_text(path, most=MOST_TEXT_BYTES)
        image = parse_yaml(text)["image"]
        if not isinstance(image, str):
            raise TypeError(image)
        return parse_ros_map(str(path), read_bytes(_image_of(path, image)), text)
    except OSError as error:
        raise SourceError(
            f"{one_line(str(error.filename or path))}: cannot be read as a map ({error.strerror or error}); give a run "
            "folder or a map.yaml"
        ) from error
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: names no image; give a run folder or the YAML file of a map") from error
    except InputError as error:
        raise SourceError(str(error)) from error


def _image_of(description: Path, image: str) -> Path:
    """Where the image of a map lies; map_saver writes the whole path, which is wrong after the map was moved."""
    named = description.parent / Path(image)
    beside = description.parent / named.name
    return beside if beside.is_file() and not named.is_file() else named


def _map(image: bytes, description: str) -> OccupancyMap:
    content, resolution_m, (x, y, yaw), occupied, free = read_description(description)
    mode = content.get("mode", "trinary")
    if mode not in _MODES:
        raise ValueError(f"`mode` is {one_line(repr(mode))}; use one of {', '.join(_MODES)}")
    grey, opaque = _decoded(image)
    occupancy = _occupancy(mode, negate=number_in({"negate": 0, **content}, "negate") != 0.0)
    by_grey = np.full(256, Occupancy.UNKNOWN, np.uint8)
    by_grey[occupancy <= free] = Occupancy.FREE
    by_grey[occupancy >= occupied] = Occupancy.OCCUPIED
    cells: Cells = cv2.LUT(grey, by_grey)
    if opaque is not None and mode != "raw":
        cells[~opaque] = Occupancy.UNKNOWN
    for kind, what in ((Occupancy.OCCUPIED, "occupied"), (Occupancy.FREE, "free")):
        if not (cells == kind).any():
            raise ValueError(
                f"no cell is {what} by `mode` {mode}, `occupied_thresh` {occupied:g}, `free_thresh` {free:g} and "
                "`negate`; correct them"
            )
    cells, origin_xy = _along_the_axes(cells[::-1], (x, y), yaw, resolution_m)
    return OccupancyMap(frozen(cells, np.uint8), resolution_m, origin_xy)


def decoded_image(image: bytes) -> Any:
    """The pixels as OpenCV reads them, without its messages; None if it cannot read them."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        whole = image + b"\n" * image.startswith(b"P2")  # OpenCV needs white space behind the last number
        return cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_UNCHANGED) if image else None
    except cv2.error:  # more pixels than OpenCV reads
        return None
    finally:
        cv2.utils.logging.setLogLevel(before)


def _decoded(image: bytes) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Grey values and which pixels are opaque, each (H, W); None if all are."""
    check_image(image)
    pixels = decoded_image(image)
    if pixels is None:
        raise ValueError("the image cannot be read; copy it again, or save it as PGM or PNG")
    if (white := _white(image, pixels.dtype)) != 255:
        pixels = np.round(np.minimum(pixels, white) * (255.0 / white)).astype(np.uint8)
    if pixels.ndim == 2:
        return pixels, None
    opaque = pixels[..., 3] == 255 if pixels.shape[2] == 4 else None
    return cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_BGR2GRAY), opaque


def _white(image: bytes, dtype: np.dtype[Any]) -> int:
    header = _PGM.match(image)
    if header is None:
        return np.iinfo(dtype).max
    return 255 if header[1] == b"2" and dtype == np.uint8 else int(header[2])


def _occupancy(mode: str, negate: bool) -> NDArray[np.float64]:
    """Occupancy of a cell by grey value, shape (256,); NaN is unknown."""
    grey = np.arange(256.0)
    if mode == "raw":
        return np.where(grey <= 100, grey / 100, np.nan)  # percent
    return grey / 255.0 if negate else 1.0 - grey / 255.0


def _along_the_axes(
    cells: Cells, origin_xy: tuple[float, float], yaw: float, resolution_m: float
) -> tuple[Cells, tuple[float, float]]:
    """The cells whose lower left corner is turned by ``yaw``, as cells along the axes, and the corner of these."""
    if yaw == 0.0:
        return cells, origin_xy
    c, s = math.cos(yaw), math.sin(yaw)
    height, width = cells.shape
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) @ np.array([[c, s], [-s, c]])
    lowest = np.floor(corners.min(axis=0) + _ROUNDING)
    columns, rows = (np.ceil(corners.max(axis=0) - _ROUNDING) - lowest).astype(int).tolist()
    if columns * rows > _MOST_PIXELS:
        raise ValueError(f"the turned map has {columns} x {rows} cells, which would fill the memory; crop the map")
    # Pixel centres have whole coordinates in cv2 and lie half a cell from the corners of the map.
    x, y = lowest + 0.5
    inverse = np.array([[c, s, c * x + s * y - 0.5], [-s, c, -s * x + c * y - 0.5]])
    turned = cv2.warpAffine(
        np.ascontiguousarray(cells),
        inverse,
        (columns, rows),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=int(Occupancy.UNKNOWN),
    )
    x, y = np.array(origin_xy) + lowest * resolution_m
    return turned, (float(x), float(y))
