"""Requests that nobody should send cost little, and what they say is not repeated."""

import asyncio
import logging
import socket
import ssl
import threading
import time
from datetime import UTC, datetime

import httpx
import pytest
import uvicorn

from fcslam.service.authentication import Identity, Role
from fcslam.service.credentials import make_credentials
from fcslam.service.http import limits
from fcslam.service.http.limits import KNOWN_AT_ONCE, RequestLimits
from fcslam.service.http.protocol import GuardedProtocol, GuardedServer
from tests.service.http.desk import A

API = "/api/v1"


def test_a_path_with_a_slash_too_many_is_not_redirected_to_where_the_request_says(desk):
    response = desk.ask("GET", "/healthz/", headers={"Host": "evil.example"})
    assert response.status_code == 404
    assert "evil" not in response.text + str(response.headers)


def test_an_aborted_body_is_no_fault_of_the_service(desk, caplog):
    url = desk.client.base_url
    head = f"POST {API}/robots/a/packets HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer token of a\r\n"
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            with socket.create_connection((url.host, url.port)) as connection:
                connection.sendall(f"{head}Content-Length: 1000\r\n\r\nabc".encode())
        desk.told(desk.send("a", A[:3]))
    assert "Traceback" not in caplog.text
    assert not [record for record in caplog.records if record.exc_info]


def test_requests_without_a_token_are_limited_and_those_with_one_are_not(desk):
    url, many = desk.client.base_url, 400
    asked = b"GET /healthz HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer guess\r\n\r\n" * many
    with socket.create_connection((url.host, url.port)) as connection:
        connection.sendall(asked)
        began = time.monotonic()
        assert desk.ask("GET", f"{API}/robots/a/state", "a").status_code == 200
        assert connection.recv(1 << 20).count(b"HTTP/1.1") < many
        assert time.monotonic() - began < many / limits.PER_S, "the robot does not wait for them"


class Asked:
    """A request, who sends it from where, and its connection."""

    def __init__(self, gate, who, address=""):
        self.is_unfinished = self.is_closed = False
        scope = {"type": "http", "client": (address or who, 1), "who": who, "state": {limits.CONNECTION: self}}
        self.task = asyncio.ensure_future(gate(scope, None, self.send))

    async def send(self, message):
        """Nobody reads it."""

    def close(self):
        self.is_closed, self.is_unfinished = True, False


class Gate:
    """Limits before an application that notes who comes, and answers nobody before ``answer`` has a turn."""

    def __init__(self, **options):
        self.came, self.answer = [], asyncio.Semaphore(0)
        names = {"a": Identity("a", Role.ROBOT), "b": Identity("b", Role.ROBOT)}
        self.limits = RequestLimits(self._app, lambda scope: names.get(scope["who"]), **options)

    async def _app(self, scope, _, send):
        asked = scope["state"][limits.CONNECTION]
        self.came.append(scope["client"][0])
        async with self.answer:
            await send({"type": "http.response.start", "status": 204})
        while asked.is_unfinished:
            await asyncio.sleep(0)

    async def ask(self, *who):
        asked = [Asked(self.limits, *each) for each in who]
        await settle()
        return asked


async def settle():
    for _ in range(9):
        await asyncio.sleep(0)


def test_requests_without_a_token_wait_for_each_other_and_addresses_take_turns():
    async def check():
        gate = Gate()
        await gate.ask(*[("?", "crowd")] * 60, ("?", "other"), ("a", "robot"))
        assert gate.came == ["crowd"] * limits.AT_ONCE + ["robot"]
        while len(gate.came) < limits.AT_ONCE + 4:
            await asyncio.sleep(0.01)
        assert "other" in gate.came[limits.AT_ONCE : limits.AT_ONCE + 4]

    asyncio.run(check())


def test_a_token_has_a_few_requests_at_a_time_and_its_addresses_take_turns():
    async def check():
        gate = Gate()
        await gate.ask(*[("a", "thief")] * (3 * KNOWN_AT_ONCE), ("a", "robot"), ("b", "b"))
        assert gate.came == ["thief"] * KNOWN_AT_ONCE + ["b"], "another robot does not wait"
        for _ in range(2):
            gate.answer.release()
        await asyncio.sleep(2.0 * KNOWN_AT_ONCE / limits.KNOWN_PER_S)
        assert "robot" in gate.came

    asyncio.run(check())


def test_a_long_answer_takes_no_place_once_it_has_begun():
    async def check():
        gate = Gate()
        asked = await gate.ask(*[("a", "x")] * KNOWN_AT_ONCE, ("a", "y"))
        for one in asked:
            one.is_unfinished = True
        gate.answer.release()
        while "y" not in gate.came:
            await asyncio.sleep(0.01)
        assert (gate.came[-1], [one.task.done() for one in asked]) == ("y", [False] * len(asked))
        for one in asked:
            one.close()

    asyncio.run(check())


def test_of_a_token_the_request_whose_body_does_not_come_makes_room_first():
    async def check():
        gate = Gate(patience_s=0.0)
        asked = await gate.ask(*[("a", "x")] * KNOWN_AT_ONCE)
        for one in asked[2:5]:
            one.is_unfinished = True
        await gate.ask(("b", "y"))
        assert not any(one.is_closed for one in asked), "nobody waits"
        await gate.ask(("a", "z"), ("a", "z"))
        await asyncio.sleep(0.01)
        assert [k for k, one in enumerate(asked) if one.is_closed] == [2, 3], "the oldest ones, one for each that waits"

    asyncio.run(check())


@pytest.mark.slow
def test_a_tls_handshake_that_does_not_come_is_hung_up_on(tmp_path):
    make_credentials(tmp_path, ["127.0.0.1"], {}, datetime.now(UTC))

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    config = uvicorn.Config(
        app,
        http=GuardedProtocol,
        lifespan="off",
        ws="none",
        ssl_certfile=tmp_path / "cloud.pem",
        ssl_keyfile=tmp_path / "cloud.key",
    )
    listening = socket.create_server(("127.0.0.1", 0))
    server = GuardedServer(config, handshake_s=1.0)
    thread = threading.Thread(target=server.run, args=([listening],))
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        with socket.create_connection(listening.getsockname(), timeout=30.0) as connection:
            assert connection.recv(1) == b"", "asyncio's own limit is a minute"
        url = f"https://127.0.0.1:{listening.getsockname()[1]}"
        assert httpx.get(url, verify=ssl.create_default_context(cafile=tmp_path / "ca.pem")).status_code == 204
    finally:
        server.should_exit = True
        thread.join()
        listening.close()
