"""What the page says of robots and maps: pure functions of its script, run by Node."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from fcslam.page import ASSETS

NODE = shutil.which("node")
CHECKS = Path(__file__).with_name("words_checks.js")
"""Calls the functions, and prints what they say."""
pytestmark = pytest.mark.skipif(NODE is None, reason="there is no Node")


@pytest.fixture(scope="module")
def told():
    script = "".join(path.read_text(encoding="utf-8") for path in (ASSETS / "words.js", CHECKS))
    done = subprocess.run(
        [NODE, "--input-type=module"], input=script, capture_output=True, text=True, check=True, timeout=60
    )
    return json.loads(done.stdout)


def test_the_state_of_a_robot_is_true(told):
    assert told["states"] == [
        ["ok", "Maps, on its map"],
        ["ok", "Maps, on the shared map"],
        ["wait", "Maps, not joined with the others yet"],
        ["wait", "Maps, not on a map yet"],
        ["alert", "Silent for 2 min: switched off, or without network"],
        ["past", "Not heard for 2 h, on its map"],
        ["past", "Drive ended, on the shared map"],
        ["past", "Not heard since the service started; on its map"],
        ["past", "Removed by hand; the map is without it"],
        ["past", "Earlier drive, ended"],
        ["ok", "Finished, on the shared map"],
        ["wait", "Finished, not joined with the others yet"],
    ]


def test_the_evidence_names_what_it_rests_on(told):
    assert told["sensors"] == ["laser scanner", "camera", "tag"]


def test_metrics_and_plots_are_in_words(told):
    assert told["names"] == [
        "places seen by two robots, accepted", "words of the lidar vocabulary, detector birds-1", "sent by robot_1",
        "map area",
    ]  # fmt: skip
    assert told["plots"] == [
        ["Other drives confirm its pose", [0.5, 0.75], "75 %"],
        ["Since its last message", [1, 2], "2 s"],
        ["Messages a second", [0, 3], "3"],
    ]


def test_attention_has_what_needs_a_person_and_is_empty_otherwise(told):
    assert told["well"] == []
    assert told["silent"] == [["a and c have been silent, the first for 2 min.", "Show the robots"]]
    assert told["disk"] == ["The disk of the service has 0.4 GB left."]
    assert told["late"] == ["The map lacks the last 2 min: 3 messages of robots, 1 drive among them."]


def test_a_verdict_is_that_of_the_service_and_says_if_the_map_is_behind(told):
    assert told["verdicts"] == [
        {"kind": "ok", "text": "Use this map."},
        {
            "kind": "alert",
            "text": "So far: do not use this map yet: it moved. The map lacks the last 20 s: 3 messages of robots, "
            "1 drive among them.",
        },
    ]


def test_times_are_those_of_the_clock_or_of_the_drive(told):
    assert told["times"] == ["8 s", "1 min", "2 min", "2 h", "1 day", "3 days", "1:17 min", "1:17 min into the drive"]
    assert told["history"] == [
        [0, "a begins to map"],
        [0, "b begins to map"],
        [8, "a and b saw the same place for the first time"],
        [60, "a: last scan in the map, after 9.00 m"],
        [60, "b: last scan in the map, after 9.00 m"],
        [None, "anna: marked a part as free"],
    ]
