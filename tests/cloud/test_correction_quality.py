"""How well a correction is borne out: nothing alone, more with every witness, nothing where others see otherwise."""

import pytest

from fcslam.cloud.correction_quality import MOST_TIES
from fcslam.records import Correction, Veto
from fcslam.wire.packets import decode, encode
from tests.scripted import ALIAS, closures, rectangle, stream
from tests.small_fleet import feed

POSES = rectangle()
A, B = ("a", POSES), ("b", POSES)
PAIRS = [(k, k) for k in range(0, 48, 4)]
EXPLAINED = 0.9
"""Of every scripted match."""


def two_robots():
    return [*stream(*A, start_s=0.0), *stream(*B, start_s=1000.0)]


def qualities(cloud):
    return {correction.robot: correction.quality for correction in cloud.fleet.corrections()}


@pytest.mark.parametrize("count", [3, 5, 12])
def test_every_closure_to_others_counts_for_both_robots(scripted, count):
    cloud = feed(scripted(closures(A, B, PAIRS[:count])), two_robots())
    expected = EXPLAINED * (1.0 - 0.5 ** min(count, MOST_TIES))
    assert cloud.fleet.closure_counts()["between robots"] == count
    assert qualities(cloud) == pytest.approx({"a": expected, "b": expected})


def test_nobody_bears_out_a_robot_in_a_map_of_its_own(scripted):
    assert qualities(feed(scripted(closures(A, B, PAIRS[:2])), two_robots())) == {"a": 0.0, "b": 0.0}


def test_a_robot_hears_of_it_with_the_place_that_joins_it(scripted):
    cloud, heard = scripted(closures(A, B, PAIRS[:5])), []
    for packet in two_robots():
        for body in (decode(data).body for data in cloud.receive(encode(packet))):
            if isinstance(body, Correction) and packet.robot == "b":
                heard.append(body.quality)
    assert heard[:2] == [0.0, pytest.approx(EXPLAINED * 0.875)]
    assert heard == sorted(heard)
    assert len(heard) == 4, "places in new surroundings do not change it, so no correction is sent"


def test_a_place_that_shows_something_else_than_the_map_bears_out_nothing(scripted):
    cloud = feed(scripted(closures(A, B, PAIRS[:5]), closures(A, B, [(48, 48)], shift=ALIAS)), two_robots())
    assert qualities(cloud) == {"a": 0.0, "b": 0.0}


def test_what_is_vetoed_bears_out_nothing(scripted):
    cloud = feed(scripted(closures(A, B, PAIRS[:5])), two_robots())
    cloud.fleet.edit([Veto("a", "b")])
    assert qualities(cloud) == {"a": 0.0, "b": 0.0}
