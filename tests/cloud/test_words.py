"""Robots that send words: two-point fusion of their maps, end to end, and what the cloud refuses."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.settings import FleetConfig, FusionStrategy
from fcslam.errors import InputError, PacketError
from fcslam.places.matcher import MatchDecision, MatcherConfig
from fcslam.places.words import WordVocabulary, write_vocabularies
from fcslam.records import Channel, KeyscanId, MapTile, WordPlace, frozen
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import encode
from tests.scripted import LASER, keyscan, motion

CODES = np.random.default_rng(0).integers(0, 256, (64, 32), np.uint8)
VOCABULARY = WordVocabulary(Channel.LIDAR, "test-1", frozen(np.unique(CODES, axis=0), np.uint8))
STEP = np.array([1.0, 0.0, 0.0])
HELLO = Hello("a", 0, (LASER,), {Channel.LIDAR: "test-1"}, vocabularies={Channel.LIDAR: VOCABULARY.digest})
BARE = replace(keyscan("a", 0, 0.0), ranges_m=frozen([], np.float32))
PLACE = WordPlace(
    KeyscanId("a", 0), Channel.LIDAR, "test-1", 0, 0, frozen([[1.0, 2.0]], np.float32), frozen([3], np.uint16)
)
TILE = MapTile("a", 0.05, 0, 0, frozen(np.ones((256, 256)), np.uint8))


@pytest.fixture
def path(tmp_path):
    write_vocabularies([VOCABULARY], tmp_path / "test.words")
    return tmp_path / "test.words"


def fleet_config(path, decision=MatchDecision.SIMILARITY):
    return FleetConfig(fusion=FusionStrategy.TWO_POINT, matcher=MatcherConfig(decision=decision), vocabularies=(path,))


def cloud_of(path, *bodies, decision=MatchDecision.SIMILARITY):
    cloud = Cloud(fleet_config(path, decision), 0)
    for number, body in enumerate(bodies):
        cloud.receive(encode(Packet("a", 0, number, 10.0, body)))
    return cloud


def test_what_fits_is_taken(path):
    result = cloud_of(path, HELLO, BARE, PLACE, TILE).finalize()
    (robot,) = result.robots
    assert robot.keyscans == ()
    assert np.array_equal(robot.own_map.cells, TILE.cells)


REFUSED = {
    "another vocabulary": ((replace(HELLO, vocabularies={Channel.LIDAR: bytes(32)}),), "the cloud has"),
    "the vocabulary of another detector": (
        (replace(HELLO, detector_versions={Channel.LIDAR: "test-2"}),),
        "is of lidar detector test-1",
    ),
    "the vocabulary of another channel": (
        (
            replace(
                HELLO,
                detector_versions={Channel.CAMERA: "test-1"},
                vocabularies={Channel.CAMERA: VOCABULARY.digest},
            ),
        ),
        "is of lidar detector",
    ),
    "words without a vocabulary": ((replace(HELLO, vocabularies={}), BARE, PLACE), "no vocabulary was announced"),
    "a word beyond it": ((HELLO, BARE, replace(PLACE, words=frozen([64], np.uint16))), "word 64 of a vocabulary of"),
    "a place again": ((HELLO, BARE, PLACE, PLACE), "described before"),
    "a tile before any keyscan": ((HELLO, TILE), "names keyscan 0"),
    "a tile again": ((HELLO, BARE, TILE, TILE), "was sent before"),
    "a tile of other cells": ((HELLO, BARE, TILE, replace(TILE, column=1, resolution_m=0.1)), "another resolution"),
    "tiles far apart": ((HELLO, BARE, TILE, replace(TILE, column=40, row=-40)), "41 by 41 tiles"),
    "a tile far away": ((HELLO, BARE, replace(TILE, column=30000)), "at most 20000 m"),
}


@pytest.mark.parametrize(("bodies", "reason"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused_with_the_reason(path, bodies, reason):
    with pytest.raises(PacketError, match=reason):
        cloud_of(path, *bodies)


def test_a_cloud_that_verifies_by_geometry_takes_no_words_and_no_bare_keyscans(path):
    geometry = MatchDecision.GEOMETRY
    with pytest.raises(PacketError, match=r"sends words; .* \(fleet\.matcher\.decision\)"):
        cloud_of(path, HELLO, decision=geometry)
    with pytest.raises(PacketError, match="keyscan 0 without ranges"):
        cloud_of(path, replace(HELLO, vocabularies={}), BARE, decision=geometry)


def test_a_vocabulary_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(InputError, match="not a readable vocabulary"):
        Cloud(fleet_config(tmp_path / "none"), 0)


def test_a_restored_fleet_has_the_map_and_goes_on(path):
    first = [HELLO, BARE, PLACE, TILE]
    rest = [replace(BARE, id=KeyscanId("a", 1)), motion("a", 0, 1, STEP), replace(TILE, column=1)]
    packets = [Packet("a", 0, number, 10.0, body) for number, body in enumerate([*first, *rest])]
    fleet = cloud_of(path, *first).fleet
    applied = {PacketNumber("a", packet.sequence): packet for packet in packets[: len(first)]}
    again = Fleet.restored(fleet_config(path), 0, fleet.state(), applied.__getitem__)
    for packet in packets[len(first) :]:
        fleet.apply(packet)
        again.apply(packet)
    one, other = (each.conclude().robots[0].own_map for each in (fleet, again))
    assert one.cells.shape == (256, 512)
    assert np.array_equal(one.cells, other.cells)
