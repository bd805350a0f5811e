"""The stream of events: it never falls silent, and ends with the token or the service."""

import threading

import pytest

from fcslam.service.http.state import EventStream
from tests.service.http.desk import ENTRIES, Desk


@pytest.fixture
def desk(tmp_path):
    with Desk(tmp_path / "data") as opened:
        yield opened


def stream(desk):
    return desk.client.stream("GET", "/api/v1/events", headers={"Authorization": "Bearer token of eye"})


def test_a_comment_comes_when_nothing_happens(desk):
    with stream(desk) as response:
        lines = response.iter_lines()
        assert [next(lines) for _ in range(4)] == [": nothing new", "", ": nothing new", ""]
        desk.state.events.publish("live", 7)
        assert "event: live" in lines
        assert next(lines) == 'data: {"number": 7}'


def test_a_stream_ends_with_its_token(desk):
    with stream(desk) as response:
        lines = response.iter_lines()
        next(lines)
        desk.state.authenticator.replace([entry for entry in ENTRIES if entry.name != "eye"])
        assert {*lines} <= {": nothing new", ""}


def test_a_stream_ends_with_the_service(desk):
    with stream(desk) as response:
        lines = response.iter_lines()
        next(lines)
        desk.state.close()
        assert {*lines} <= {": nothing new", ""}


class _Interrupted(dict):
    """A dictionary whose first reader is overtaken by ``other``."""

    def __init__(self, other):
        self.other = threading.Thread(target=other)

    def get(self, *key):
        found = super().get(*key)
        if self.other.ident is None:
            self.other.start()
            self.other.join(0.2)
        return found


def test_of_two_that_publish_at_once_none_is_lost():
    """As of the supervisors of a mission that was closed and opened again."""
    events = EventStream()
    events._newest = _Interrupted(lambda: events.publish("result", 2))
    events.publish("closed", 1)
    events._newest.other.join()
    assert {kind: number for kind, (_, number) in events.newest().items()} == {"closed": 1, "result": 2}
