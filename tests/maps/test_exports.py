"""A map as a drawing and on the earth."""

import io
import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from pyproj import CRS, Transformer

from fcslam.maps.exports import EarthFrame, earth_frame, export_map, geotiff, map_svg
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, map_yaml, pgm_bytes, pixels_of

MAP = OccupancyMap(np.random.default_rng(0).integers(0, 3, (40, 70)).astype(np.uint8), 0.05, (-1.2, 3.4))
FRAME = EarthFrame(latitude_deg=48.1, longitude_deg=11.5, x_axis_from_east_deg=30.0)


def test_a_drawing_has_the_area_of_the_cells():
    drawing = ElementTree.fromstring(map_svg(MAP))
    assert drawing.get("viewBox") == "-1.2 -5.4 3.5 2"
    floor, walls = (path.get("d") for path in drawing.iter("{http://www.w3.org/2000/svg}path"))
    drawn = np.zeros((2, *MAP.cells.shape), int)
    for k, path in enumerate((floor, walls)):
        for x, y, length in re.findall(r"M(\d+) (\d+)h(\d+)v1h-\3z", path):
            drawn[k, int(y), int(x) : int(x) + int(length)] += 1
    np.testing.assert_array_equal(drawn[0], MAP.cells != Occupancy.UNKNOWN)
    np.testing.assert_array_equal(drawn[1], MAP.cells == Occupancy.OCCUPIED)


def test_pixels_lie_where_a_projection_of_the_earth_says():
    """The oracle is pyproj, with the projection that the file names."""
    image = Image.open(io.BytesIO(geotiff(MAP, FRAME)))
    np.testing.assert_array_equal(np.array(image), pixels_of(MAP.cells[::-1]))
    affine, numbers = np.reshape(image.tag_v2[34264], (4, 4)), image.tag_v2[34736]
    assert numbers == (11.5, 48.1, 0.0, 0.0, 1.0)
    keys = np.reshape(image.tag_v2[34735], (-1, 4))
    assert len(keys) == keys[0, 3] + 1
    assert (np.diff(keys[:, 0]) > 0).all()
    projected = CRS.from_proj4("+proj=tmerc +lat_0=48.1 +lon_0=11.5 +k=1 +ellps=WGS84")
    place = Transformer.from_crs(projected, 4326, always_xy=True)
    east, north = (affine @ (0.0, 40.0, 0.0, 1.0))[:2]  # the map's lower left corner
    longitude, latitude = place.transform(east, north)
    turn = math.radians(30.0)
    x, y = MAP.origin_xy
    assert (latitude - 48.1) * 111_200 == pytest.approx(math.sin(turn) * x + math.cos(turn) * y, abs=0.01)
    assert (longitude - 11.5) * 111_320 * math.cos(math.radians(48.1)) == pytest.approx(
        math.cos(turn) * x - math.sin(turn) * y, abs=0.02
    )


def test_a_map_without_a_known_place_has_no_geotiff(tmp_path):
    (tmp_path / "map.pgm").write_bytes(pgm_bytes(MAP))
    (tmp_path / "map.yaml").write_text(map_yaml(MAP, "map.pgm"))
    assert export_map(tmp_path, 0, "svg") == map_svg(MAP).encode()
    place = tmp_path / "map_georeference.json"
    refusal = b'{"georeferenced": false, "reason": "too few"}'
    for content in (None, refusal, b'{"latitude_deg": 91}', b"[" * 100_000, b"{}", b"\xff"):
        if content is not None:
            place.write_bytes(content)
        assert earth_frame(tmp_path, 0) is None
        assert export_map(tmp_path, 0, "tif") is None
    place.write_text(FRAME.model_dump_json())
    assert export_map(tmp_path, 0, "tif") == geotiff(MAP, FRAME)
    assert export_map(tmp_path, 1, "svg") is None
