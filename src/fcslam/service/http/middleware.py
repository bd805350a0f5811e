"""What every request passes before its route, as plain ASGI: limits, names, counts and the audit log."""

import asyncio
import re
import time
from collections import deque
from collections.abc import Callable
from contextvars import ContextVar
from functools import cache
from ipaddress import ip_address
from socket import gethostname
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fcslam.records import NAME
from fcslam.service.http.limits import CONTENT
from fcslam.service.http.problems import problem
from fcslam.service.http.state import ACTOR, ServiceState
from fcslam.service.intake import TokenBuckets

PER_S, AT_ONCE = 100.0, 20.0
"""Requests that are answered, on average and at once: each takes about a millisecond of the process."""
MOST_WAITING = 4096
"""Requests that wait for a turn; of more, one of the address that has most is refused."""
WAITING = "waiting"
"""Key in the state of a request that waits: its connection may be closed to make room."""


class UnauthenticatedLimit:
    """One budget for all requests without a known token, so that they cannot delay the robots.

    Each waits for its turn, and a connection has one request at a time: so clients that send without pause slow down
    themselves. Turns go round the addresses, so that one address cannot take those of the others.
    """

    def __init__(self, app: ASGIApp, is_known: Callable[[Scope], bool], most_waiting: int = MOST_WAITING) -> None:
        self._app, self._is_known, self._most_waiting = app, is_known, most_waiting
        self._waiting: dict[str, deque[asyncio.Future[bool]]] = {}
        """By address, that of the next turn first."""
        self._count = 0
        self._passed = TokenBuckets(time.monotonic, PER_S, AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when it is its turn, or refuse it."""
        if scope["type"] == "http" and not self._is_known(scope) and (self._waiting or self._passed.wait_s("", 1.0)):
            if self._count >= self._most_waiting:
                self._drop()
            if not await self._turn(scope):
                text = f"{self._most_waiting} requests without a known token wait already; send a token"
                await problem(429, text, {"retry-after": "60", "connection": "close"})(scope, receive, send)
                return
        await self._app(scope, receive, send)

    async def _turn(self, scope: Scope) -> bool:
        """Wait for the turn; false if the request has to make room."""
        loop = asyncio.get_running_loop()
        turn: asyncio.Future[bool] = loop.create_future()
        if not self._waiting:
            loop.call_later(1.0 / PER_S, self._next)
        self._waiting.setdefault((scope.get("client") or ("",))[0], deque()).append(turn)
        self._count += 1
        scope["state"][WAITING] = True
        try:
            return await turn
        finally:
            del scope["state"][WAITING]

    def _drop(self) -> None:
        """Refuse the newest request of the address that has most."""
        address, turns = max(self._waiting.items(), key=lambda each: len(each[1]))
        turn = turns.pop()
        self._count -= 1
        if not turns:
            del self._waiting[address]
        if not turn.done():
            turn.set_result(False)

    def _next(self) -> None:
        """Give the turn to the next address that waits."""
        if not self._waiting:
            return
        address, turns = next(iter(self._waiting.items()))
        del self._waiting[address]
        turn = turns.popleft()
        self._count -= 1
        if turns:
            self._waiting[address] = turns
        if not turn.done():
            turn.set_result(True)
        if self._waiting:
            asyncio.get_running_loop().call_later(1.0 / PER_S, self._next)


def local_names(app: ASGIApp) -> ASGIApp:
    """Refuse requests by a name that is not this machine's, and changes that pages of other sites send.

    A page may have its own name pointed to this machine (DNS rebinding), or send a form to it (cross-site request
    forgery). A service that knows nobody's token needs it: a browser sends the name of the page that asks.
    """

    async def check(scope: Scope, receive: Receive, send: Send) -> None:
        answer = app
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            if not is_local_name(headers.get("host", "")):
                text = (
                    "a service without tokens answers to its address, its host name and localhost; ask by one of these"
                )
                answer = problem(421, text)
            elif scope["method"] not in ("GET", "HEAD", "OPTIONS") and is_cross_site(headers):
                answer = problem(
                    403, "a page of another site sends this; a service without tokens takes no changes from it"
                )
        await answer(scope, receive, send)

    return check


def is_cross_site(headers: Headers) -> bool:
    """Whether a browser sends a request for a page that is not of this service; other programs send neither header."""
    if (site := headers.get("sec-fetch-site")) is not None:  # absent over http from other machines
        return site not in ("same-origin", "none")
    origin = headers.get("origin")
    return origin is not None and urlsplit(origin).netloc != headers.get("host")


@cache
def _own_names() -> frozenset[str]:
    host = gethostname().lower()
    return frozenset({"localhost", host, f"{host.partition('.')[0]}.local"})


def is_local_name(host: str) -> bool:
    """Whether a Host header is an IP address, localhost or this machine's own name, with or without a port."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name in _own_names() or bool(ip_address(name))
    except ValueError:
        return False


_ADDRESS: Final = re.compile(rf"/missions/({NAME.pattern})(/(?!healthz$|readyz$).*)", re.ASCII)


def named_missions(app: ASGIApp, named: ContextVar[str | None]) -> ASGIApp:
    """Take ``/missions/NAME`` off the path, and note the name in a context variable: the request is about it."""

    async def take(scope: Scope, receive: Receive, send: Send) -> None:
        found = _ADDRESS.fullmatch(scope["path"]) if scope["type"] == "http" else None
        if found is None:
            await app(scope, receive, send)
            return
        before = named.set(found[1])
        try:
            await app({**scope, "path": found[2], "raw_path": found[2].encode()}, receive, send)
        finally:
            named.reset(before)

    return take


def watched(app: ASGIApp, state: ServiceState) -> ASGIApp:
    """Count answers that refuse, and write the audit log.

    Plain ASGI: a middleware of Starlette's own base runs a task for every request.
    """

    def note(scope: Scope, status: int) -> None:
        address = (scope.get("client") or ("",))[0]
        if status >= 400:
            state.measures.refuse(status)
        if status == 401:
            state.audit.refuse_login(address)
        known = scope.get("state", {})
        if ACTOR in known:
            asked = f"?{scope['query_string'].decode('latin-1')}" if scope["query_string"] else ""
            action = f"{scope['method']} {scope['path']}{asked}"[:300]  # anybody with a token chooses the rest
            state.audit.record(known[ACTOR], address, action, status, known.get(CONTENT, {}))

    async def watch(scope: Scope, receive: Receive, send: Send) -> None:
        async def noting(message: Message) -> None:
            if message["type"] == "http.response.start":
                note(scope, message["status"])
            await send(message)

        await app(scope, receive, noting)

    return watch
