"""Maps of other programs: what Nav2's map_server loads has the same cells here."""

import math
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.maps.occupancy_map import Occupancy
from fcslam.mission.localization import read_map

F, O, U = Occupancy.FREE, Occupancy.OCCUPIED, Occupancy.UNKNOWN  # noqa: E741
CELLS = np.array([[O, O, O, O], [O, F, F, U], [O, F, U, U]])
"""Row 0 at the lowest y."""
GREY = np.vectorize({F: 254, O: 0, U: 205}.get)(CELLS[::-1]).astype(np.uint8)
LINES = {
    "image": "map.pgm",
    "mode": "trinary",
    "resolution": "0.05",
    "origin": "[-1.0, 2.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def png(pixels):
    return cv2.imencode(".png", pixels)[1].tobytes()


def endless_png():
    """A small file that states 65536 x 65536 pixels."""
    header = b"IHDR" + b"\x00\x01\x00\x00" * 2 + png(GREY)[24:29]
    return png(GREY)[:12] + header + zlib.crc32(header).to_bytes(4, "big") + png(GREY)[33:]


def pgm(pixels, white=255, comment="# CREATOR: map_saver\n"):
    height, width = pixels.shape
    content = pixels.astype(">u2" if white > 255 else np.uint8).tobytes()
    return f"P5\n{comment}{width} {height}\n{white}\n".encode() + content


def ascii_pgm(pixels, white=255):
    height, width = pixels.shape
    rows = "\n".join(" ".join(map(str, row)) for row in pixels.tolist())
    return f"P2\n# by hand\n{width} {height}\n{white}\n{rows}\n".encode()


def with_alpha(pixels, transparent):
    bgr = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return np.dstack((bgr, np.where(transparent, 0, 255).astype(np.uint8)))


def save(folder: Path, pixels: bytes, **lines) -> Path:
    (folder / "map.pgm").write_bytes(pixels)
    content = {**LINES, **lines}
    (folder / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in content.items() if value))
    return folder / "map.yaml"


UNKNOWN_IN_IMAGE = CELLS[::-1] == U
PERCENT = np.where(GREY == 205, 255, np.where(GREY == 0, 100, 0)).astype(np.uint8)


@pytest.mark.parametrize(
    ("image", "lines"),
    [
        (pgm(GREY), {}),
        (pgm(GREY), {"mode": ""}),
        (pgm(np.round(GREY / 2.55), 100), {}),
        (pgm(GREY.astype(int) * 257, 65535), {}),
        (ascii_pgm(GREY).rstrip(), {}),
        (ascii_pgm(GREY.astype(int) * 4, 1020), {}),
        (png(GREY), {}),
        (png(cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR)), {}),
        (png(GREY.astype(np.uint16) * 257), {}),
        (png(with_alpha(np.where(GREY == 205, 254, GREY).astype(np.uint8), UNKNOWN_IN_IMAGE)), {"mode": "scale"}),
        (cv2.imencode(".bmp", GREY)[1].tobytes(), {}),
        (pgm(255 - GREY), {"negate": "1"}),
        (pgm(GREY), {"mode": "scale"}),
        (pgm(PERCENT), {"mode": "raw"}),
        (pgm(np.where(GREY == 254, 255, GREY)), {"occupied_thresh": "1.0", "free_thresh": "0.0"}),
        (pgm(np.where(GREY == 205, 60, GREY)), {"occupied_thresh": "0.8", "free_thresh": "5e-2"}),
    ],
)
def test_the_cells_are_those_of_map_server(tmp_path, image, lines):
    found = read_map(save(tmp_path, image, **lines))
    assert np.array_equal(found.cells, CELLS)
    assert found.resolution_m == 0.05
    assert found.origin_xy == (-1.0, 2.0)


def test_the_image_may_lie_elsewhere(tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "office.pgm").write_bytes(pgm(GREY))
    for image in (tmp_path / "there" / "office.pgm", "../there/office.pgm"):
        assert np.array_equal(read_map(save(tmp_path / "here", b"", image=image)).cells, CELLS)
    (tmp_path / "there" / "office.pgm").rename(tmp_path / "here" / "office.pgm")
    moved = save(tmp_path / "here", b"", image="/home/someone/office.pgm")
    assert np.array_equal(read_map(moved).cells, CELLS)
    with pytest.raises(SourceError, match=r"/home/someone/other\.pgm: cannot be read as a map"):
        read_map(save(tmp_path / "here", b"", image="/home/someone/other.pgm"))


@pytest.mark.parametrize("yaw", [0.3, -1.2, math.pi / 2, math.pi, 3.5])
def test_a_yaw_turns_the_map_about_its_corner(tmp_path, yaw):
    room = np.full((60, 80), 254, np.uint8)
    room[[0, 1, -2, -1]] = room[:, [0, 1, -2, -1]] = 0
    room[5:20, 5:30] = 0
    found = read_map(save(tmp_path, pgm(room), origin=f"[-1.0, 2.0, {yaw}]"))
    straight = read_map(save(tmp_path, pgm(room)))
    rows, columns = np.indices(straight.cells.shape)
    inside = np.stack((columns.ravel() + 0.5, rows.ravel() + 0.5), axis=1) * 0.05
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    at = (inside @ turn.T + (-1.0, 2.0) - found.origin_xy) / 0.05
    column, row = np.floor(at).astype(int).T
    same = found.cells[row, column] == straight.cells.ravel()
    right_angle = abs(math.sin(2 * yaw)) < 1e-9
    assert same.mean() == 1.0 if right_angle else same.mean() > 0.97
    assert np.count_nonzero(found.cells) == pytest.approx(60 * 80, rel=0.0 if right_angle else 0.01)


@pytest.mark.parametrize(
    ("image", "lines", "words"),
    [
        (pgm(GREY), {"mode": "Trinary"}, "`mode` is 'Trinary'; use one of trinary, scale, raw"),
        (pgm(GREY), {"origin": "[0, 0]"}, "`origin` in the description must be"),
        (pgm(GREY), {"resolution": "0"}, "`resolution` is 0; give"),
        (pgm(GREY), {"occupied_thresh": ""}, "`occupied_thresh` in the description is missing"),
        (pgm(GREY)[:-3], {}, "the image cannot be read; copy it again"),
        (b"", {}, "the image cannot be read"),
        (png(np.full((4, 4), 254, np.uint8)), {}, "no cell is occupied by `mode` trinary, `occupied_thresh` 0.65"),
        (pgm(GREY), {"mode": "raw"}, "no cell is occupied by `mode` raw"),
        (pgm(GREY), {"free_thresh": "-1"}, "no cell is free by"),
        (endless_png(), {}, "65536 x 65536 pixels, which would fill"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, image, lines, words, capfd):
    with pytest.raises(SourceError) as caught:
        read_map(save(tmp_path, image, **lines))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""
