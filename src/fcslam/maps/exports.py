"""An occupancy map for programs outside of robotics: a drawing (SVG), and a raster on the earth (GeoTIFF)."""

import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from fcslam.maps.occupancy_map import GEOREFERENCE, Occupancy, OccupancyMap, map_stem, parse_map, pixels_of
from fcslam.untrusted import MOST_TEXT_BYTES, read_bytes, read_text

_WALL, _FLOOR = "#1a1a1a", "#e8edf2"
_TRANSFORMATION, _KEYS, _NUMBERS = 34264, 34735, 34736
"""Tags of GeoTIFF: from pixels to coordinates, the coordinate system, and numbers that it refers to."""
_SMOOTHED_CELLS = 0.7
"""Outlines leave the cells' corners by less."""


class EarthFrame(BaseModel):
    """How a map's frame lies on the earth (WGS 84), as its file in the run folder says."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    """Longitude of the origin of the frame."""
    x_axis_from_east_deg: float
    """Direction of the x axis, counterclockwise."""


def earth_frame(folder: Path, number: int) -> EarthFrame | None:
    """How a map of a run folder lies on the earth; None if that is not known."""
    try:
        return EarthFrame.model_validate_json(
            read_text(folder / (map_stem(number) + GEOREFERENCE), folder, MOST_TEXT_BYTES)
        )
    except (OSError, ValueError):  # no fixes, or they were refused
        return None


def export_map(folder: Path, number: int, suffix: str) -> bytes | None:
    """A map of a run folder as ``svg`` or ``tif``, or its ``pgm`` and ``yaml`` as ``zip``.

    None if there is no such map, or if a GeoTIFF is asked for and the map's place on the earth is unknown.
    """
    stem = map_stem(number)
    try:
        pgm, description = (read_bytes(folder / f"{stem}.{end}", folder) for end in ("pgm", "yaml"))
    except OSError:
        return None
    if suffix == "zip":
        return zipped({f"{stem}.pgm": pgm, f"{stem}.yaml": description})
    occupancy = parse_map(stem, pgm, description.decode(errors="replace"))
    if suffix == "svg":
        return map_svg(occupancy).encode()
    frame = earth_frame(folder, number)
    return None if frame is None else geotiff(occupancy, frame)


def map_svg(occupancy: OccupancyMap) -> str:
    """Known and occupied cells as areas; one unit is a metre, and y points up."""
    height, width = occupancy.cells.shape
    side, (x, y) = occupancy.resolution_m, occupancy.origin_xy
    box = " ".join(f"{value:.10g}" for value in (x, -y - height * side, width * side, height * side))
    floor = _area(occupancy.cells != Occupancy.UNKNOWN)
    walls = _area(occupancy.cells == Occupancy.OCCUPIED)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}">\n'
        f'<g transform="matrix({side:.10g} 0 0 {-side:.10g} {x:.10g} {-y:.10g})">\n'
        f'<path fill="{_FLOOR}" d="{floor}"/>\n<path fill="{_WALL}" d="{walls}"/>\n</g>\n</svg>\n'
    )


def _area(mask: NDArray[np.bool_]) -> str:
    """The cells of a mask (H, W) as the data of a path: a rectangle for each run of cells in a row."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, begins = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    runs = zip(begins.tolist(), rows.tolist(), (ends - begins).tolist(), strict=True)
    return "".join(f"M{x} {y}h{length}v1h-{length}z" for x, y, length in runs)


def outlines(mask: NDArray[np.bool_], occupancy: OccupancyMap) -> str:
    """The outlines of a mask (H, W) of a map's cells as the data of an SVG path in metres of the map.

    They run through the middles of cells, so a line of single cells is a line.
    """
    rings, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    paths = []
    for ring in rings:
        corners = cv2.approxPolyDP(ring, _SMOOTHED_CELLS, closed=True)[:, 0]
        metres = (corners + 0.5) * occupancy.resolution_m + np.array(occupancy.origin_xy)
        paths.append("M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in metres) + "z")
    return "".join(paths)


def zipped(files: Mapping[str, bytes]) -> bytes:
    """Files by name as a ZIP archive; the same files give the same bytes."""
    archive = io.BytesIO()
    with ZipFile(archive, "w", ZIP_DEFLATED) as writer:
        for name, content in files.items():
            writer.writestr(ZipInfo(name), content, ZIP_DEFLATED)
    return archive.getvalue()


def geotiff(occupancy: OccupancyMap, frame: EarthFrame) -> bytes:
    """The grey values of map_server as a GeoTIFF.

    Its coordinate system is a transverse Mercator projection around the origin of the map's frame (WGS 84, scale 1), so
    coordinates are metres to the east and north of this origin.
    """
    from PIL import Image, TiffImagePlugin, TiffTags

    side, (x, y) = occupancy.resolution_m, occupancy.origin_xy
    turn = math.radians(frame.x_axis_from_east_deg)
    cos, sin, top = math.cos(turn), math.sin(turn), y + occupancy.cells.shape[0] * side
    # (column, row) of a pixel's upper left corner -> (east, north): rows run against y.
    affine = np.eye(4)
    affine[:2] = (
        (side * cos, side * sin, 0.0, cos * x - sin * top),
        (side * sin, -side * cos, 0.0, sin * x + cos * top),
    )
    affine[2, 2] = 0.0
    numbers = (frame.longitude_deg, frame.latitude_deg, 0.0, 0.0, 1.0)
    # Key, tag of its value, number of values, value or index of the value.
    keys = (
        (1, 1, 0, 12),
        (1024, 0, 1, 1),  # model type: projected
        (1025, 0, 1, 1),  # a pixel is an area
        (2048, 0, 1, 4326),  # geographic system: WGS 84
        (3072, 0, 1, 32767),  # projected system: defined here
        (3074, 0, 1, 32767),  # projection: defined here
        (3075, 0, 1, 1),  # method: transverse Mercator
        (3076, 0, 1, 9001),  # unit: metre
        (3080, _NUMBERS, 1, 0),  # longitude of the natural origin
        (3081, _NUMBERS, 1, 1),  # latitude
        (3082, _NUMBERS, 1, 2),  # false easting
        (3083, _NUMBERS, 1, 3),  # false northing
        (3092, _NUMBERS, 1, 4),  # scale at the natural origin
    )
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, values in (
        (_TRANSFORMATION, TiffTags.DOUBLE, tuple(affine.ravel().tolist())),
        (_NUMBERS, TiffTags.DOUBLE, numbers),
        (_KEYS, TiffTags.SHORT, sum(keys, ())),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = values
    written = io.BytesIO()
    Image.fromarray(pixels_of(occupancy.cells[::-1])).save(written, "TIFF", compression="tiff_deflate", tiffinfo=tags)
    return written.getvalue()


def rmf_yaml(plan: OccupancyMap, is_picture: bool, level: str) -> str:
    """Where a map that lies in a floor plan is in Open-RMF: ``reference_coordinates`` for the fleet adapters.

    Open-RMF counts the metres of a plan ``is_picture`` from its upper left corner, with y up, so y is negative.
    """
    height_m, width_m = (plan.resolution_m * cells for cells in plan.cells.shape)
    x, y = plan.origin_xy
    corners = np.array([[x, y], [x + width_m, y], [x + width_m, y + height_m], [x, y + height_m]])
    top_left = corners[3] if is_picture else np.zeros(2)
    lines = (
        f"    {name}: {points.round(4).tolist()}" for name, points in (("rmf", corners - top_left), ("robot", corners))
    )
    return "\n".join(("reference_coordinates:", f"  {json.dumps(level)}:", *lines, ""))
