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

from fcslam.service.credentials import make_credentials
from fcslam.service.http import middleware
from fcslam.service.http.middleware import UnauthenticatedLimit
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
        assert time.monotonic() - began < many / middleware.PER_S, "the robot does not wait for them"


def test_requests_without_a_token_wait_for_each_other_and_addresses_take_turns():
    answered = []

    async def app(scope, receive, send):
        answered.append(scope["client"][0])

    async def ask():
        gate = UnauthenticatedLimit(app, lambda scope: scope["client"][0] == "robot")
        many = [("crowd", n) for n in range(60)] + [("other", 0), ("robot", 0)]
        await asyncio.gather(*(gate({"type": "http", "client": who, "state": {}}, None, None) for who in many))

    asyncio.run(ask())
    assert answered.index("robot") <= middleware.AT_ONCE
    assert answered.index("other") <= middleware.AT_ONCE + 3
    assert len(answered) == 62


def test_too_many_waiting_requests_without_a_token_are_refused():
    told = []

    async def app(scope, receive, send):
        pass

    async def send(message):
        told.append(message.get("status"))

    async def ask():
        gate = UnauthenticatedLimit(app, lambda _: False, most_waiting=2)
        crowd = (gate({"type": "http", "client": ("x", 1), "state": {}}, None, send) for _ in range(30))
        await asyncio.gather(*crowd)

    asyncio.run(ask())
    assert told.count(429) == 30 - int(middleware.AT_ONCE) - 2


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
