"""Every route, taken from the application itself: who has no right to it gets nothing and changes nothing."""

import asyncio
import hashlib
import sqlite3

import pytest
from fastapi.routing import APIRoute, iter_route_contexts
from hypothesis import given
from hypothesis import strategies as st

from fcslam.service.authentication import Authenticator, Role, TokenEntry
from tests.service.http.desk import A, Desk, put_detector

pytestmark = pytest.mark.slow

OPEN = {"/healthz", "/readyz", "/openapi.json"}
VALUES = {
    "layer": "changes",
    "number": 1,
    "robot": "a", "k": "0", "suffix": "png", "z": "0", "x": "0", "y": "0", "session": "a", "name": "mission",
    "channel": "camera", "version": "v1", "epoch": 0, "robot_i": "a", "stamp_i": "1.5", "robot_j": "b", "stamp_j": "2",
}  # fmt: skip
READERS = {Role.VIEWER, Role.ADMIN}
RIGHTS = {"robots": {Role.ROBOT}, "decisions": {Role.ADMIN}, "missions": {Role.ADMIN}}
"""By tag; what is not listed is for readers."""
EXCEPTIONS = {
    ("GET", "/api/v1/detectors/{channel}/{version}"): set(Role),
    ("GET", "/api/v1/robots/{robot}/map"): set(Role),
    ("GET", "/api/v1/robots/{robot}/points"): set(Role),
    ("GET", "/api/v1/frontiers"): set(Role),
    ("GET", "/api/v1/quality"): set(Role),
    ("GET", "/api/v1/missions"): READERS,
    ("GET", "/api/v1/audit"): {Role.ADMIN},
}
ENDLESS = {"/api/v1/events"}


@pytest.fixture(scope="module")
def routes(tmp_path_factory):
    with Desk(tmp_path_factory.mktemp("service") / "data") as desk:
        return [
            (method, route.path, route)
            for route in iter_route_contexts(desk.app.routes)
            for method in sorted(route.methods or ())
            if method != "HEAD"
        ]


def rights(method, path, route):
    (tag,) = route.route.tags
    return EXCEPTIONS.get((method, path), RIGHTS.get(tag, READERS))


def content(desk):
    """All that is stored."""
    with sqlite3.connect(desk.state.mission.folder.store) as database:
        text = hashlib.sha256("\n".join(database.iterdump()).encode()).hexdigest()
    database.close()
    return text, desk.state.missions.names, desk.state.mission.folder.name


def test_the_routes_are_all_there(routes):
    assert len(routes) >= 30
    assert {path for _, path, route in routes if not isinstance(route.route, APIRoute)} <= OPEN


@pytest.mark.parametrize("who", [None, "nobody", "a", "b", "eye", "boss"])
def test_who_has_no_right_gets_nothing_and_changes_nothing(desk, routes, who):
    desk.told(desk.send("a", A[:9]))
    put_detector(desk, b"secret network")
    before = content(desk)
    role = {"a": Role.ROBOT, "b": Role.ROBOT, "eye": Role.VIEWER, "boss": Role.ADMIN}.get(who)
    refused = 0
    for method, path, route in routes:
        if path in OPEN:
            continue
        allowed = role in rights(method, path, route) and not (who == "b" and "{robot}" in path)
        if allowed:
            continue
        response = desk.ask(method, path.format(**VALUES), who, content=b"x" * 10)
        assert response.status_code == (401 if role is None else 403), (method, path, response.text)
        assert set(response.json()) == {"error"}
        refused += 1
    assert refused > (0 if who == "boss" else 5)
    assert content(desk) == before


def test_a_stranger_gets_no_data(desk):
    """Only whether the service is ready, and what requests it knows."""
    interface = desk.ask("GET", "/openapi.json").json()
    assert interface["info"]["title"] == "fcslam"
    desk.told(desk.send("a", A[:9]))
    answers = {path: desk.ask("GET", path) for path in sorted(OPEN)}
    assert {answer.status_code for answer in answers.values()} == {200}
    assert answers["/healthz"].json().keys() | answers["/readyz"].json().keys() == {
        *("status", "backlog", "lacking_packets", "lacking_sessions", "lacking_s")
    }
    assert answers["/openapi.json"].json() == interface, "whatever robots sent"


def test_nothing_is_read_of_a_body_before_it_is_known_who_sends_it(desk, routes):
    async def receive():
        raise AssertionError("the body is read")

    async def ask(method, path):
        answers = []

        async def send(message):
            answers.append(message)

        scope = {
            "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b"name=x",
            "headers": [(b"content-type", b"application/json"), (b"content-length", b"1000000000000")],
            "http_version": "1.1", "scheme": "http", "root_path": "",
        }  # fmt: skip
        await desk.app(scope, receive, send)
        return answers[0]["status"]

    posts = [path.format(**VALUES) for method, path, _ in routes if method == "POST"]
    assert len(posts) >= 7
    assert {path: asyncio.run(ask("POST", path)) for path in posts} == dict.fromkeys(posts, 401)


@pytest.mark.parametrize("who", ["a", "eye", "boss"])
def test_who_has_the_right_is_not_turned_away(desk, routes, who):
    desk.told(desk.send("a", A[:9]))
    role = {"a": Role.ROBOT, "eye": Role.VIEWER, "boss": Role.ADMIN}[who]
    for method, path, route in routes:
        if path in OPEN | ENDLESS or role not in rights(method, path, route):
            continue
        response = desk.ask(method, path.format(**VALUES), who)
        assert response.status_code not in (401, 403, 405), (method, path)
        assert response.status_code < 500, (method, path, response.text)
        assert response.headers["cache-control"] in ("no-store", "private, no-cache"), (method, path)


def test_without_tokens_nobody_is_asked_for_one(tmp_path, routes):
    with Desk(tmp_path / "data", tokens=None) as desk:
        for method, path, _ in routes:
            if path not in ENDLESS:
                assert desk.ask(method, path.format(**VALUES)).status_code not in (401, 403)


@pytest.mark.parametrize(
    "header",
    [
        "",
        "Bearer",
        "Bearer ",
        "Basic token of eye",
        "Bearer token of eye2",
        "token of eye",
        "Bearer \xff\xfe",
        "B" * 5000,
    ],
)
def test_what_is_no_known_token_is_nobody(header):
    digest = hashlib.sha256(b"token of eye").hexdigest()
    authenticator = Authenticator([TokenEntry(name="eye", role=Role.VIEWER, sha256=digest)])
    assert authenticator.who(header) is None
    assert authenticator.who(None) is None
    assert authenticator.who(f"bearer {'token of eye'}").name == "eye"
    assert authenticator.who(f"Bearer {digest}") is None


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory):
    with Desk(tmp_path_factory.mktemp("fuzzed") / "data", tokens=None) as desk:
        desk.told(desk.send("a", A[:9]))
        yield desk


@given(
    path=st.sampled_from(["robots/a/packets", "detectors", "missions/import?name=new", "vetoes", "missions"]),
    body=st.one_of(st.binary(min_size=1, max_size=300), st.sampled_from([b"{}", b"[]", b'{"name": 3}', b"\0" * 4])),
)
def test_bytes_that_are_nothing_are_refused_in_words(fuzzed, path, body):
    """Cases that schemathesis does not try: it takes any body of bytes for a right one."""
    response = fuzzed.ask("POST", f"/api/v1/{path}", content=body)
    assert 400 <= response.status_code < 500, response.text
    assert response.json()["error"]
