import numpy as np
import yaml

from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.fusion import fuse
from fcslam.maps.occupancy_map import Occupancy, map_yaml, pgm_bytes
from fcslam.records import Keyscan, KeyscanId, LaserModel
from tests.lidar.worlds import box, ranges

CONFIG = OccupancyConfig()
LASERS = {
    "a": (LaserModel(361, -np.pi, np.pi / 180, 30.0),),
    "b": (LaserModel(181, -np.pi / 2, np.pi / 180, 20.0, (0.2, 0.0, 0.0)),),
}
CORRIDOR = {"left": -1.02, "bottom": -0.73, "right": 6.03, "top": 2.48}  # no symmetry: a flip is seen
WALLS = box(*CORRIDOR.values())


def fleet():
    poses = np.array([(0.5 * k, 0.1 * k, 0.4 * k) for k in range(9)])
    keyscans = []
    for k, pose in enumerate(poses):
        robot = "ab"[k % 2]
        seen = ranges(pose, WALLS, LASERS[robot][0])[0]
        keyscans.append(Keyscan(KeyscanId(robot, k // 2), float(k), seen))
    return keyscans, poses


class MapServer:
    """A reader of our files after map_server's documentation, sharing no code with the writer."""

    def __init__(self, pgm, text):
        info = yaml.safe_load(text)
        magic, size, depth, pixels = pgm.split(b"\n", 3)
        assert (magic, depth) == (b"P5", b"255")
        assert info["mode"] == "trinary"
        self.width, self.height = (int(value) for value in size.split())
        assert len(pixels) == self.width * self.height
        self.pixels, self.info = pixels, info

    def at(self, x, y):
        """100 occupied, 0 free, -1 unknown; also outside."""
        left, bottom, turn = self.info["origin"]
        assert turn == 0
        column, row = int((x - left) // self.info["resolution"]), int((y - bottom) // self.info["resolution"])
        if not (0 <= column < self.width and 0 <= row < self.height):
            return -1
        value = self.pixels[(self.height - 1 - row) * self.width + column]
        occupancy = value / 255.0 if self.info["negate"] else (255 - value) / 255.0
        if occupancy > self.info["occupied_thresh"]:
            return 100
        return 0 if occupancy < self.info["free_thresh"] else -1


def test_map_server_reads_back_every_cell_where_it_was_and_the_walls_stand_where_the_robots_saw_them():
    fused = fuse(*fleet(), LASERS, CONFIG)
    served = MapServer(pgm_bytes(fused), map_yaml(fused, "map.pgm"))
    meaning = {Occupancy.UNKNOWN: -1, Occupancy.FREE: 0, Occupancy.OCCUPIED: 100}
    side, (left, bottom) = fused.resolution_m, fused.origin_xy
    for (row, column), cell in np.ndenumerate(fused.cells):
        assert served.at(left + (column + 0.5) * side, bottom + (row + 0.5) * side) == meaning[Occupancy(cell)]
    assert set(np.unique(fused.cells)) == set(Occupancy)
    for x, y in [(CORRIDOR["right"], 1.0), (CORRIDOR["left"], 1.0), (2.0, CORRIDOR["top"]), (2.0, CORRIDOR["bottom"])]:
        assert max(served.at(x + dx, y + dy) for dx in (-0.03, 0, 0.03) for dy in (-0.03, 0, 0.03)) == 100
    assert served.at(2.0, 1.0) == 0
    assert served.at(5.0, 2.0) == 0
    assert served.at(2.0, -0.95) == -1
    assert served.at(-3.0, 1.0) == -1


def test_the_same_keyscans_in_any_order_make_the_same_bytes():
    keyscans, poses = fleet()
    order = np.random.default_rng(0).permutation(len(keyscans))
    one, other = fuse(keyscans, poses, LASERS, CONFIG), fuse([keyscans[k] for k in order], poses[order], LASERS, CONFIG)
    assert pgm_bytes(one) == pgm_bytes(other)
    assert map_yaml(one, "map.pgm") == map_yaml(other, "map.pgm")


def test_the_image_name_survives_yaml():
    fused = fuse([], np.empty((0, 3)), {}, CONFIG)
    for name in ("map.pgm", "map 1: yes.pgm", "no", "#x.pgm"):
        assert yaml.safe_load(map_yaml(fused, name))["image"] == name
    assert pgm_bytes(fused) == b"P5\n1 1\n255\n\xcd"
