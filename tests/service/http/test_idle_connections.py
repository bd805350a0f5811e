"""Whoever holds connections without a request locks nobody out."""

import contextlib
import socket
import time

import httpx
import pytest

from fcslam.service.http import protocol
from tests.cli.test_serve import API, Service

pytestmark = [pytest.mark.system, pytest.mark.attack]


@contextlib.contextmanager
def held(url, count, beginning=b""):
    """Open connections that send no more than the beginning of a request."""
    address = httpx.URL(url)
    with contextlib.ExitStack() as stack:
        connections = []
        for _ in range(count):
            connection = socket.create_connection((address.host, address.port), timeout=10.0)
            stack.callback(connection.close)
            with contextlib.suppress(ConnectionError):
                connection.sendall(beginning)
            connections.append(connection)
        yield connections


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    service = Service(tmp_path_factory.mktemp("service") / "data")
    yield service
    service.kill()


@pytest.mark.parametrize("rest", [None, b"X: ", b"Content-Length: 9\r\n\r\n"])
def test_thousands_of_idle_connections_lock_nobody_out(service, rest):
    protocol.allow_many_connections()
    beginning = b"" if rest is None else b"POST /api/v1/robots/a/packets HTTP/1.1\r\nHost: x\r\n" + rest
    with held(service.url, protocol.MOST_CONNECTIONS + 200, beginning):
        for _ in range(20):
            headers = {"Fcslam-Agent": "x"}
            response = httpx.get(f"{service.url}{API}/robots/a/state", headers=headers, timeout=5.0, verify=False)
            assert response.status_code == 200


def test_a_connection_without_a_request_is_closed(service):
    with held(service.url, 2, b"GET / HT") as connections:
        began = time.monotonic()
        for connection in connections:
            connection.settimeout(5 * protocol.IDLE_S)
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        assert time.monotonic() - began > 0.5 * protocol.IDLE_S


def test_a_client_that_asks_again_and_again_keeps_its_connection(service):
    """A new one would wait behind those of an attacker."""
    ports, end = set(), time.monotonic() + 1.5 * protocol.IDLE_S
    with httpx.Client(verify=False) as client:
        while time.monotonic() < end:
            answer = client.get(f"{service.url}/healthz")
            ports.add(answer.extensions["network_stream"].get_extra_info("client_addr")[1])
            time.sleep(1.0)
    assert len(ports) == 1


def trickle(connection, count):
    for _ in range(count):
        connection.sendall(b"X")
        time.sleep(1.0)


def test_a_header_that_trickles_in_is_closed(service):
    with held(service.url, 1, b"GET / HTTP/1.1\r\n") as (connection,), pytest.raises(ConnectionError):
        trickle(connection, int(5 * protocol.IDLE_S))
