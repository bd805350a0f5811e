"""Requests and replies of a fleet, with a clock that the test moves."""

import asyncio
import contextlib
import threading
import time

import httpx
import numpy as np
import pytest

from fcslam.learning.federated.fleet_grid import MAX_ROBOTS, ONLINE_S, FleetGrid
from fcslam.learning.federated.fleet_server import PATH, fleet_app
from fcslam.learning.federated.messages import TrainingReply, TrainingRequest, write_reply
from fcslam.learning.federated.settings import FederatedSettings

WEIGHTS = {"a": np.ones(3, np.float32)}
REQUEST = TrainingRequest(True, WEIGHTS, "light-1", 0, "run", FederatedSettings())


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


@contextlib.contextmanager
def asked(grid, *robots):
    """Replies to a request, complete after the block."""
    replies = {}
    waiting = threading.Thread(target=lambda: replies.update(grid.ask(robots, REQUEST, 30.0)))
    waiting.start()
    end = time.monotonic() + 30.0
    while any(grid.next_request(robot) is None for robot in robots):
        assert time.monotonic() < end
    yield replies
    waiting.join(30.0)
    assert not waiting.is_alive()


def reply_of(robot):
    return write_reply(TrainingReply(robot, REQUEST.version, WEIGHTS, {}))


def test_a_reply_comes_back_to_who_asked(grid):
    with asked(grid, "one") as replies:
        number, _ = grid.next_request("one")
        assert grid.next_request("two") is None
        assert grid.reply_limit("one", number) > 0
        assert grid.store_reply("one", number, reply_of("one"))
    assert (replies["one"].robot, replies["one"].error) == ("one", "")
    assert grid.next_request("one") is None


def test_a_robot_that_starts_again_gets_its_request_again(grid):
    with asked(grid, "one"):
        number, _ = grid.next_request("one")
        assert grid.next_request("one")[0] == number
        grid.store_reply("one", number, reply_of("one"))


def test_only_the_first_reply_counts_and_only_that_of_the_robot_asked(grid):
    with asked(grid, "one") as replies:
        number, _ = grid.next_request("one")
        assert not grid.store_reply("two", number, reply_of("two"))
        assert not grid.store_reply("one", number + 1, reply_of("one"))
        assert grid.reply_limit("two", number) == 0
        assert grid.store_reply("one", number, reply_of("one"))
        assert not grid.store_reply("one", number, b"\xff")
    assert replies["one"].error == ""


def test_a_reply_that_is_none_becomes_an_error(grid):
    with asked(grid, "one") as replies:
        assert grid.store_reply("one", grid.next_request("one")[0], b"\xff\xff\xff\xff")
    assert replies["one"].error


@pytest.mark.attack
def test_a_reply_beyond_the_limit_is_read_no_further(grid):
    with asked(grid, "one") as replies:
        number, _ = grid.next_request("one")
        limit, read, part = grid.reply_limit("one", number), 0, bytes(10_000)

        async def endless():
            nonlocal read
            while read < 10 * limit:
                read += len(part)
                yield part

        async def reply():
            app = fleet_app(grid)
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as client:
                return await client.post(PATH.format(robot="one") + f"/reply/{number}", content=endless())

        answer = asyncio.run(reply())
    assert (answer.status_code, answer.text) == (413, f"a reply of more than {limit} bytes")
    assert read <= limit + len(part)
    assert replies["one"].error == f"a reply of more than {limit} bytes"


def test_a_robot_is_online_for_a_while(grid, clock):
    assert grid.robots() == ["one", "two"]
    clock.now = ONLINE_S
    assert grid.admits("two")
    clock.now = ONLINE_S + 0.1
    assert grid.robots() == ["two"]


def test_a_request_is_withdrawn_at_the_deadline(grid):
    assert grid.ask(["one"], REQUEST, 0.0) == {}
    assert grid.next_request("one") is None


def test_a_fleet_has_room_for_so_many():
    grid = FleetGrid()
    assert all(grid.admits(str(number)) for number in range(MAX_ROBOTS))
    assert not grid.admits("one more")
    assert grid.admits("0")
