"""A fleet that is restored from its state goes on exactly as the one that never stopped."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketLog, PacketNumber
from fcslam.cloud.settings import FleetConfig
from fcslam.places.matcher import MatcherConfig
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.storage.snapshot import from_state, to_state
from fcslam.storage.state_file import read_state, write_state
from tests import small_fleet
from tests.small_fleet import fingerprint, in_order, restored

CONFIG = FleetConfig(
    solve_every=5,
    submaps_kept=8,
    matcher=MatcherConfig(small_fleet=4, most_nearby=3, most_places=30, vocabulary=VocabularyConfig(train_batch=8)),
)
"""Everything that a long mission goes through, in a short one: training, forgetting, released keyscans, solves."""


@pytest.fixture(scope="module")
def packets():
    """Two robots of three, one of them in two sessions."""
    a, b, c = small_fleet.draw(3).robots
    again = [
        replace(packet, robot=a.name, epoch=1, time=packet.time + 50.0) for packet in small_fleet.sent_by(c, a.name)
    ]
    return in_order([*small_fleet.sent_by(a), *small_fleet.sent_by(b), *again])


@pytest.fixture(scope="module")
def uninterrupted(packets):
    return go_on(Fleet(CONFIG, 0), packets)


def go_on(fleet, packets):
    for packet in packets:
        fleet.apply(packet)
    return fleet


def believed(fleet):
    corrections = [(c.robot, c.version, c.map_index, c.T_map_odom.tobytes(), c.quality) for c in fleet.corrections()]
    return fingerprint(fleet.estimate()), corrections, fleet.vocabularies(), fleet.closure_counts()


def same(one, other):
    assert believed(one) == believed(other)
    assert fingerprint(one.conclude()) == fingerprint(other.conclude())


@pytest.mark.slow
def test_restarts_anywhere_change_nothing(packets, uninterrupted, tmp_path):
    cuts = np.sort(np.random.default_rng(0).integers(0, len(packets), 3))
    fleet = Fleet(CONFIG, 0)
    for begin, end in zip([0, *cuts], [*cuts, len(packets)], strict=True):
        fleet = restored(go_on(fleet, packets[begin:end]), packets, tmp_path / "state", CONFIG)
    assert believed(fleet) == believed(uninterrupted)
    expected = restored(uninterrupted, packets, tmp_path / "state", CONFIG)
    same(fleet, expected)


def test_a_log_survives_with_its_gaps_and_refusals(tmp_path):
    log = PacketLog()
    for sequence in (0, 1, 3, 4, 7):
        log.add(PacketNumber("a", sequence), float(sequence))
    log.refuse(PacketNumber("a", 2))
    assert [number.sequence for number in log.ready("a")] == [0, 1, 3, 4]
    write_state(tmp_path / "log", "test", to_state(log))
    again = from_state(PacketLog, read_state(tmp_path / "log", "test"))
    for each in (log, again):
        each.add(PacketNumber("a", 5), 9.0)
        each.add(PacketNumber("a", 6), 8.0)
    assert list(again.ready("a")) == list(log.ready("a")) == [PacketNumber("a", n) for n in (5, 6, 7)]
    assert to_state(again) == to_state(log)
    assert PacketNumber("a", 2) in again
