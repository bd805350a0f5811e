"""A robot that sends words: no range and no descriptor leaves it, and its map comes out as it was."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from fcslam.config import parse
from fcslam.errors import FeatureError, InputError
from fcslam.features.birdseye import DETECTOR_VERSION
from fcslam.maps.fusion import joined_tiles, laid_together
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.mission.mission import MissionConfig
from fcslam.places.words import train_words, write_vocabularies
from fcslam.records import Channel, Constraint, Keyscan, MapTile, Place, WordPlace
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.words import Sends, WordsConfig, tiles_of
from fcslam.wire.messages import Hello
from fcslam.wire.packets import measure
from tests import small_fleet


def test_a_map_comes_back_from_its_tiles():
    rng = np.random.default_rng(0)
    own = OccupancyMap(rng.integers(0, 3, (300, 520), np.uint8), 0.05, (-13.0, 2.5))
    tiles = list(tiles_of(own, "a"))
    assert [(tile.column, tile.row) for tile in tiles] == [(c, r) for r in (0, 1) for c in (-2, -1, 0, 1)][: len(tiles)]
    joined = joined_tiles(tiles)
    row, column = (round((a - b) / 0.05) for a, b in zip(own.origin_xy[::-1], joined.origin_xy[::-1], strict=True))
    inside = joined.cells[row : row + 300, column : column + 520]
    assert np.array_equal(inside, own.cells)
    assert np.count_nonzero(joined.cells) == np.count_nonzero(own.cells)


def test_a_tile_without_a_known_cell_is_not_sent():
    cells = np.zeros((600, 600), np.uint8)
    cells[10, 10] = cells[590, 590] = 1
    assert [(t.column, t.row) for t in tiles_of(OccupancyMap(cells, 0.1, (0.0, 0.0)), "a")] == [(0, 0), (2, 2)]


def test_a_map_that_is_turned_covers_the_same_area():
    cells = np.ones((200, 100), np.uint8)
    cells[:, 40:43] = 2
    own = OccupancyMap(cells, 0.05, (1.0, -2.0))
    alone = OccupancyMap(np.zeros((1, 1), np.uint8), 0.05, (0.0, 0.0))
    turned = laid_together([(alone, np.zeros(3)), (own, np.array([3.0, -1.0, 0.7]))], 10**7)
    for state in (1, 2):
        assert np.isclose(np.sum(turned.cells == state), np.sum(cells == state), rtol=0.05)
    x, y = 1.0 + 41.5 * 0.05, -2.0 + 100.5 * 0.05  # the middle of the wall
    u = (np.cos(0.7) * x - np.sin(0.7) * y + 3.0 - turned.origin_xy[0]) / 0.05
    v = (np.sin(0.7) * x + np.cos(0.7) * y - 1.0 - turned.origin_xy[1]) / 0.05
    assert turned.cells[int(v), int(u)] == 2


def test_a_map_in_its_own_frame_stays_as_it_is_and_walls_outlast_coarser_cells():
    cells = np.random.default_rng(0).integers(0, 3, (64, 64), np.uint8)
    own = OccupancyMap(cells, 0.05, (-1.6, 0.0))
    assert np.array_equal(laid_together([(own, np.zeros(3))], 10**6).cells, cells)
    coarse = laid_together([(own, np.zeros(3))], 2000)
    assert coarse.resolution_m == 0.1
    assert np.array_equal(coarse.cells, cells.reshape(32, 2, 32, 2).max(axis=(1, 3)))


def test_a_known_cell_outlasts_an_unknown_one_and_a_wall_free_space():
    states = np.array([[0, 0, 0, 1, 1, 1, 2, 2, 2], [0, 1, 2, 0, 1, 2, 0, 1, 2]], np.uint8)
    maps = [(OccupancyMap(row[None], 0.5, (0.0, 0.0)), np.zeros(3)) for row in states]
    assert laid_together(maps, 100).cells.tolist() == [states.max(axis=0).tolist()]


def test_words_need_a_vocabulary_and_a_cloud_without_geometry():
    with pytest.raises(InputError, match="fcslam tools vocabulary"):
        parse(RobotConfig, {"sends": "words"}, "test")
    words = {"robot": {"sends": "words", "words": {"vocabulary": "x"}}}
    with pytest.raises(InputError, match="similarity"):
        parse(MissionConfig, words, "test")


@pytest.fixture(scope="module")
def config(packets, tmp_path_factory):
    found = [packet.body.descriptors for packet in packets if isinstance(packet.body, Place)]
    path = tmp_path_factory.mktemp("words") / "lidar.words"
    write_vocabularies([train_words(Channel.LIDAR, DETECTOR_VERSION, np.concatenate(found), 1024, seed=0)], path)
    return RobotConfig(channels=(Channel.LIDAR,), sends=Sends.WORDS, words=WordsConfig(vocabulary=path))


@pytest.fixture(scope="module")
def robot():
    return small_fleet.draw(1, path_length_m=12.0).robots[0]


@pytest.fixture(scope="module")
def sent(robot, config):
    frontend = RobotFrontend(robot.name, config)
    return [*(packet for scan in robot.scans() for packet in frontend.process(scan)), *frontend.finish()]


def test_neither_ranges_nor_descriptors_leave_the_robot(robot, sent):
    kinds = Counter(type(packet.body) for packet in sent)
    assert set(kinds) == {Hello, Keyscan, Constraint, WordPlace, MapTile}
    assert not any(len(packet.body.ranges_m) for packet in sent if isinstance(packet.body, Keyscan))
    whole = small_fleet.sent_by(robot)
    assert kinds[WordPlace] == sum(isinstance(packet.body, Place) for packet in whole)
    assert sum(measure(packet).size for packet in sent) < sum(measure(packet).size for packet in whole) / 3


def test_the_packets_come_back_as_they_were_sent(sent):
    for packet in sent:
        sized = measure(packet)
        assert len(sized.data) == sized.size


def test_a_detector_without_words_is_refused(drawn, config):
    from fcslam.robot.words import WordSender

    sender = WordSender(config.words)
    sender.check({Channel.LIDAR: DETECTOR_VERSION})
    for versions in ({Channel.LIDAR: "other-1"}, {Channel.CAMERA: "cnn-1"}):
        with pytest.raises(FeatureError, match="fcslam tools vocabulary"):
            sender.check(versions)


def test_another_vocabulary_has_another_version(sent):
    (hello,) = (packet.body for packet in sent if isinstance(packet.body, Hello))
    assert set(hello.vocabularies) == {Channel.LIDAR}
    assert replace(hello, vocabularies={}) != hello
