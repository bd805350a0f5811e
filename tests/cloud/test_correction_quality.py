"""Quality of a correction: 0 alone, more with closures nearby, less with travel, 0 where others see something else."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.correction_quality import FRESH_M, HALVED_M, TIE_HALVED_M
from fcslam.records import Correction, Veto
from fcslam.wire.packets import decode, encode
from tests.cloud.test_fleet import A, B, two_robots
from tests.scripted import ALIAS, closures
from tests.small_fleet import feed

pytestmark = pytest.mark.slow

PAIRS = [(k, k) for k in range(0, 48, 4)]
END = 60
"""Number of the last keyscan; they are 1 m apart."""
EXPLAINED = 0.9
"""Of every scripted match."""


def qualities(cloud):
    return {correction.robot: correction.quality for correction in cloud.fleet.corrections()}


def expected(pairs, compared, now=END, share=EXPLAINED):
    """Quality at keyscan ``now`` after closures at ``pairs``, if the newest comparison was at ``compared``."""
    tied = sum(0.5 ** ((now - k) / TIE_HALVED_M) for k, _ in pairs)
    return share * 0.5 ** (max(now - compared - FRESH_M, 0.0) / HALVED_M) * (1.0 - 0.5**tied)


@pytest.mark.parametrize("count", [3, 5, 12])
def test_closures_count_for_both_robots_and_less_with_travel(scripted, count):
    pairs = PAIRS[:count]
    cloud = feed(scripted(closures(A, B, pairs)), two_robots())
    assert cloud.fleet.closure_counts()["between robots"] == count
    here = expected(pairs, pairs[-1][0])
    assert qualities(cloud) == pytest.approx({"a": here, "b": here})


(UNLIKE,) = (replace(line, passes=False) for line in closures(A, B, [(48, 48)]))


def elsewhere(i, j):
    return closures(A, B, [(i, j)], shift=ALIAS)


@pytest.mark.parametrize(
    ("pairs", "others", "of_a", "of_b"),
    [
        (PAIRS[:2], [], 0.0, 0.0),
        (PAIRS[:5], elsewhere(48, 48), 0.0, 0.0),
        (PAIRS, [UNLIKE], expected(PAIRS, 48) / 2, expected(PAIRS, 48) / 2),
        (PAIRS, elsewhere(40, 44), expected(PAIRS, 44), expected(PAIRS, 44) / 2),
        (PAIRS, elsewhere(4, 48), expected(PAIRS, 44), 0.0),
        (PAIRS[:5], closures(A, B, [(0, 8), (4, 12)]), expected(PAIRS[:5], 16), expected(PAIRS[:5], 16)),
    ],
    ids=[
        "maps of their own", "the newest place shows something else", "a place is not verified where it is predicted",
        "a match differs from the map", "an older place differs", "a place with several closures counts once",
    ],
)  # fmt: skip
def test_what_bears_out_where_a_robot_is(scripted, pairs, others, of_a, of_b):
    found = qualities(feed(scripted(closures(A, B, pairs), others), two_robots()))
    assert found == pytest.approx({"a": of_a, "b": of_b})


def test_a_robot_hears_of_it_with_the_place_that_joins_it_until_it_drives_away(scripted):
    cloud, heard = scripted(closures(A, B, PAIRS[:5])), []
    for packet in two_robots():
        for body in (decode(data).body for data in cloud.receive(encode(packet))):
            if isinstance(body, Correction) and packet.robot == "b":
                heard.append(body.quality)
    assert heard[:2] == [0.0, pytest.approx(expected(PAIRS[:3], 8, now=8))]
    assert heard[3] == pytest.approx(expected(PAIRS[:5], 16, now=16))
    assert np.all(np.diff(heard[:4]) > 0.0)
    assert np.all(np.diff(heard[3:]) < 0.0)
    assert heard[-1] < 0.1


def test_what_is_vetoed_bears_out_nothing(scripted):
    cloud = feed(scripted(closures(A, B, PAIRS[:5])), two_robots())
    cloud.fleet.edit([Veto("a", "b")])
    assert qualities(cloud) == {"a": 0.0, "b": 0.0}
