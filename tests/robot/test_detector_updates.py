"""A detector is taken between two records, and a resumed recording takes it at the same one."""

import os
from concurrent.futures import Future
from dataclasses import replace

import pytest

from fcslam.errors import FeatureError, InputError
from fcslam.robot.outbox import Outbox
from fcslam.robot.uplink import DetectorUpdates
from tests.wire.examples import DETECTOR_UPDATE

FIRST, SECOND = DETECTOR_UPDATE.file, replace(DETECTOR_UPDATE.file, version="second")


class Frontend:
    def __init__(self):
        self.took = []

    def set_detector(self, file, path):
        outcome = Future()
        if path.read_bytes() == b"broken":
            outcome.set_exception(FeatureError("it is broken"))
        else:
            self.took.append(file.version)
            outcome.set_result([])
        return outcome


@pytest.fixture
def start(tmp_path):
    opened = []

    def start(resume=False):
        for outbox in opened:
            outbox.close()
        opened.append(Outbox(tmp_path / "outbox", "alice", 10**6))
        opened[-1].begin("r", resume)
        frontend = Frontend()
        updates = DetectorUpdates(tmp_path / "detectors", opened[-1], frontend)
        return updates, frontend

    yield start
    for outbox in opened:
        outbox.close()


def drive(updates, frontend, records, catching_up=0):
    """Updates that were taken before each record."""
    taken = {}
    for number in records:
        before = len(frontend.took)
        updates.apply_due(number, number < catching_up)
        if frontend.took[before:]:
            (taken[number],) = frontend.took[before:]
    return taken


def test_what_was_fetched_is_taken_before_the_next_record(start):
    updates, frontend = start()
    assert drive(updates, frontend, range(3)) == {}
    updates.store(FIRST, b"network")
    updates.store(SECOND, b"network")
    assert drive(updates, frontend, range(3, 9)) == {3: FIRST.version, 4: "second"}
    assert updates.notice == "detector second from now on"


@pytest.mark.parametrize(("catching_up", "second"), [(9, 10), (0, 7)])
def test_a_resumed_recording_takes_the_same_at_the_same_place_and_news_after_it(start, catching_up, second):
    updates, frontend = start()
    updates.store(FIRST, b"network")
    drive(updates, frontend, range(5, 9))
    again, frontend = start(resume=True)
    again.store(FIRST, b"network")  # it is announced again
    again.store(SECOND, b"network")
    assert drive(again, frontend, range(20), catching_up) == {5: FIRST.version, second: "second"}
    anew, frontend = start()
    assert drive(anew, frontend, range(20)) == {}, "another session"


def test_one_that_cannot_be_used_is_said_and_nothing_stops(start):
    updates, frontend = start()
    updates.store(FIRST, b"broken")
    assert drive(updates, frontend, range(3)) == {}
    assert updates.notice == f"detector {FIRST.version} not taken: it is broken"


def test_one_that_cannot_be_kept_is_one_line(start, tmp_path):
    updates, frontend = start()
    (tmp_path / "detectors").touch()
    with pytest.raises(InputError, match=f"detectors: cannot store detector {FIRST.version}"):
        updates.store(FIRST, b"network")
    assert drive(updates, frontend, range(3)) == {}


def test_one_that_is_kept_again_replaces_the_file_in_one_piece(start, tmp_path, monkeypatch):
    """A resumed recording may need it, whatever interrupts the writing."""
    updates, frontend = start()
    updates.store(FIRST, b"network")
    drive(updates, frontend, range(5, 9))
    again, frontend = start(resume=True)

    def full(source, target):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="no space left"):
        again.store(FIRST, b"network")
    assert [file.read_bytes() for file in (tmp_path / "detectors").glob("*.onnx")] == [b"network"]
    assert drive(again, frontend, range(20), catching_up=9) == {5: FIRST.version}
