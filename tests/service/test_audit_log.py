"""The audit log: appended to, never changed, and no way to fill the disk."""

import json
import os

import pytest

from fcslam.service.audit_log import audit_file


@pytest.fixture
def log(tmp_path):
    return audit_file(tmp_path / "audit.jsonl", lambda: 0.0)


def test_lines_are_appended_and_private(log, tmp_path):
    assert log.newest(10) == []
    for number in range(3):
        log.record("boss", "::1", "POST /x", 201, {"number": number})
    path = tmp_path / "audit.jsonl"
    assert [json.loads(line)["content"]["number"] for line in path.read_text().splitlines()] == [0, 1, 2]
    assert path.stat().st_mode & 0o077 == 0
    assert [entry.content["number"] for entry in log.newest(2)] == [1, 2]
    assert log.newest(1)[0].time == "1970-01-01T00:00:00Z"


def test_of_a_large_log_only_the_end_is_read(log, tmp_path):
    with (tmp_path / "audit.jsonl").open("wb") as file:
        file.truncate(2**40)
        file.seek(0, os.SEEK_END)
        file.write(b"\n")
    for number in range(3):
        log.record("boss", "::1", "POST /x", 201, {"number": number})
    assert [entry.content["number"] for entry in log.newest(3)] == [0, 1, 2]


def test_a_torn_line_is_left_out_and_harms_no_other(log, tmp_path):
    for number in range(3):
        log.record("boss", "::1", "POST /x", 201, {"number": number})
        with (tmp_path / "audit.jsonl").open("ab") as file:
            file.write(b'{"time":"1970-01-01T')
    assert [entry.content["number"] for entry in log.newest(10)] == [0, 1, 2]


def test_what_cannot_be_written_is_said_and_stops_nothing(tmp_path, caplog):
    log = audit_file(tmp_path / "missing" / "audit.jsonl", lambda: 0.0)
    log.record("boss", "::1", "POST /x", 201, {})
    (line,) = caplog.messages
    assert "cannot be written" in line
    assert "POST /x" in line


def test_refused_logins_left_over_are_written_at_the_end(log, tmp_path):
    for _ in range(4):
        log.refuse_login("::1")
    log.flush()
    log.flush()
    assert [entry.content["count"] for entry in log.newest(10)] == [1, 3]
    assert os.listdir(tmp_path) == ["audit.jsonl"]


def test_refused_logins_are_written_after_the_clock_went_back(tmp_path):
    clock = {}
    log = audit_file(tmp_path / "audit.jsonl", lambda: clock["now_s"])
    for clock["now_s"] in (7200.0, 3600.0, 3601.0, 7200.0):
        log.refuse_login("::1")
    assert [entry.content["count"] for entry in log.newest(10)] == [1, 1, 2]
