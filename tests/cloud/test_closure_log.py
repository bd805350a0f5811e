"""The book of closures: what is asked again and again is found without looking through all of it."""

from dataclasses import replace

import numpy as np

from fcslam.cloud.closure_log import ClosureLog
from fcslam.places.matcher import PlaceMatch
from fcslam.records import Channel, ClosureStatus, KeyscanId
from tests.scripted import Script, verified

PAIRS = [("a", "b"), ("a", "b"), ("a", "c"), ("b", "c")]
LINES = [Script(KeyscanId(i, k), KeyscanId(j, k), np.zeros(3)) for k, (i, j) in enumerate(PAIRS)]


def found(line, **changed):
    return PlaceMatch.verified(line.i, line.j, Channel.LIDAR, 0.5, replace(verified(line), **changed), predicted=False)


def test_ties_are_what_is_accepted_between_a_place_and_those_of_others():
    ledger = ClosureLog()
    entries = [ledger.add(found(line)) for line in LINES]
    ledger.add(found(LINES[0], strict=False))
    for entry in entries[1:]:
        entry.set(ClosureStatus.ACCEPTED, "")
    assert list(ledger.ties_at(KeyscanId("a", 0))) == []
    assert list(ledger.ties_at(KeyscanId("a", 1))) == entries[1:2]
    assert list(ledger.ties_at(KeyscanId("c", 3))) == entries[3:]
    assert list(ledger.ties_at(KeyscanId("d", 0))) == []
    assert [ledger.tied(robot) for robot in "abcd"] == [[1, 2], [1, 3], [2, 3], []]
