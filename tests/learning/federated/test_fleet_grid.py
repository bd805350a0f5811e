"""Requests and replies of a fleet, with a clock that the test moves."""

import asyncio
import threading

import httpx
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.learning.federated.fleet_grid import MAX_ROBOTS, ONLINE_S, FleetGrid
from fcslam.learning.federated.fleet_server import PATH, FleetApp
from fcslam.learning.federated.flower import Message, MessageType, RecordDict, message_to_bytes, request_from_bytes
from fcslam.service.http.authentication import Authenticator


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def grid(clock):
    grid = FleetGrid(clock)
    assert all(map(grid.admits, ("one", "two")))
    return grid


def ask(grid, *nodes):
    return grid.push_messages([Message(RecordDict({}), node, MessageType.TRAIN) for node in nodes])


def reply_to(data):
    return message_to_bytes(Message(RecordDict({}), reply_to=request_from_bytes(data)))


def test_a_reply_comes_back_under_the_number_of_its_request(grid):
    (number,) = ask(grid, 2)
    found = grid.next_request("one")
    assert grid.next_request("two") is None
    assert grid.reply_limit("one", found.number) > 0
    assert grid.store_reply("one", found.number, reply_to(found.data))
    (reply,) = grid.pull_messages([number])
    assert reply.metadata.src_node_id == 2
    assert grid.pull_messages([number]) == []
    assert grid.next_request("one") is None


def test_a_robot_that_starts_again_gets_its_request_again(grid):
    ask(grid, 2)
    assert grid.next_request("one") is grid.next_request("one")


def test_only_the_first_reply_counts_and_only_that_of_the_robot_asked(grid):
    ask(grid, 2)
    found = grid.next_request("one")
    assert not grid.store_reply("two", found.number, reply_to(found.data))
    assert grid.reply_limit("two", found.number) == 0
    assert grid.store_reply("one", found.number, reply_to(found.data))
    assert not grid.store_reply("one", found.number, reply_to(found.data))


def test_a_reply_that_is_none_becomes_an_error(grid):
    (number,) = ask(grid, 2)
    assert grid.store_reply("one", grid.next_request("one").number, b"\xff")
    (reply,) = grid.pull_messages([number])
    assert "cannot be read" in reply.error.reason


@pytest.mark.attack
def test_a_reply_beyond_the_limit_is_read_no_further(grid):
    (number,) = ask(grid, 2)
    found = grid.next_request("one")
    limit, read, part = grid.reply_limit("one", found.number), 0, bytes(10_000)

    async def endless():
        nonlocal read
        while read < 10 * limit:
            read += len(part)
            yield part

    async def reply():
        app = FleetApp(grid, Authenticator(None), lambda _: None).asgi()
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as client:
            return await client.post(PATH.format(robot="one") + f"/reply/{found.number}", content=endless())

    answer = asyncio.run(reply())
    assert (answer.status_code, answer.text) == (413, f"one: a reply of more than {limit} bytes")
    assert read <= limit + len(part)
    (refused,) = grid.pull_messages([number])
    assert refused.error.reason == f"a reply of more than {limit} bytes"


def test_a_robot_is_online_for_a_while(grid, clock):
    assert grid.nodes() == {}
    assert grid.admits("two")
    assert grid.nodes() == {}
    grid.mark_online("two")
    assert grid.nodes() == {"two": 3}
    clock.now = ONLINE_S + 0.1
    assert grid.nodes() == {}


def test_nobody_waits_for_a_robot_that_is_gone(grid, clock):
    """Nor keeps its request."""
    grid.mark_online("one")
    clock.now = ONLINE_S + 1.0
    messages = [Message(RecordDict({}), 2, MessageType.TRAIN)]
    assert grid.send_and_receive(messages, timeout=None) == []
    assert grid.next_request("one") is None


def test_a_request_is_withdrawn_at_the_deadline(grid, clock):
    grid.mark_online("one")
    clock.now = 1.0
    assert grid.send_and_receive([Message(RecordDict({}), 2, MessageType.TRAIN)], timeout=0.0) == []
    assert grid.next_request("one") is None


def test_who_waits_gets_the_replies(grid):
    for robot in ("one", "two"):
        grid.mark_online(robot)
    got = []
    messages = [Message(RecordDict({}), node, MessageType.TRAIN) for node in (2, 3)]
    waiting = threading.Thread(target=lambda: got.extend(grid.send_and_receive(messages, timeout=30.0)))
    waiting.start()
    for robot in ("one", "two"):
        while (found := grid.next_request(robot)) is None:
            pass
        grid.store_reply(robot, found.number, reply_to(found.data))
    waiting.join(30.0)
    assert sorted(reply.metadata.src_node_id for reply in got) == [2, 3]


def test_a_fleet_has_room_for_so_many():
    grid = FleetGrid()
    assert all(grid.admits(str(number)) for number in range(MAX_ROBOTS))
    assert not grid.admits("one more")
    assert grid.admits("0")
