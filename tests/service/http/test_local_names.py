"""A web page whose name points to this machine is no name of this machine."""

import asyncio

import httpx
import pytest

from fcslam.service.http.middleware import is_local_name, local_names

LOCAL = "localhost", "localhost:8340", "127.0.0.1:80", "[::1]:8340", "192.168.1.7", "[fe80::1]"
OTHERS = "", "evil.example", "localhost.evil.example", "127.0.0.1.evil.example:80", "[::1", "a@b:c", "localhost@evil"


@pytest.mark.parametrize("host", LOCAL + OTHERS)
def test_addresses_and_localhost_are_local_and_other_names_are_not(host):
    assert is_local_name(host) == (host in LOCAL)


def answer(method, host, headers=()):
    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    async def ask():
        transport = httpx.ASGITransport(app=local_names(app))
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{host}") as client:
            return await client.request(method, "/", headers=dict(headers))

    return asyncio.run(ask()).status_code


@pytest.mark.parametrize(("host", "status"), [("localhost:1", 204), ("evil.example", 421)])
def test_they_get_no_further(host, status):
    assert answer("GET", host) == status


OWN, OTHER = "http://localhost:1", "http://127.0.0.2:38171"


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("POST", {}, 204),
        ("POST", {"Origin": OWN}, 204),
        ("POST", {"Origin": OTHER}, 403),
        ("POST", {"Origin": "null"}, 403),
        ("DELETE", {"Origin": OTHER, "Sec-Fetch-Site": "cross-site"}, 403),
        ("POST", {"Origin": OTHER, "Sec-Fetch-Site": "same-site"}, 403),
        ("POST", {"Origin": "https://behind.a.proxy", "Sec-Fetch-Site": "same-origin"}, 204),
        ("GET", {"Origin": OTHER, "Sec-Fetch-Site": "cross-site"}, 204),
    ],
)
def test_a_page_of_another_site_changes_nothing(method, headers, status):
    assert answer(method, "localhost:1", headers.items()) == status
