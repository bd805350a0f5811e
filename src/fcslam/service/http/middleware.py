"""What every request passes before its route, as plain ASGI: limits, names, counts and the audit log."""

import asyncio
import re
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

LONGEST_ACTION = 300
"""Characters of a request in the audit log; anybody with a token chooses the rest."""
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

    def __init__(self, app: ASGIApp, is_known: Callable[[Scope], bool]) -> None:
        self._app, self._is_known = app, is_known
        self._waiting: dict[str, deque[asyncio.Future[bool]]] = {}
        """By address, that of the next turn first."""
        self._count = 0
        self._credit, self._at = AT_ONCE, 0.0
        """Requests that may pass now, as of a time of the loop."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when it is its turn, or refuse it."""
        if scope["type"] == "http" and not self._is_known(scope) and not self._passes():
            if self._count >= MOST_WAITING:
                self._drop()
            if not await self._turn(scope):
                text = f"{MOST_WAITING} requests without a known token wait already; send a token"
                await problem(429, text, {"retry-after": "60", "connection": "close"})(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _passes(self) -> bool:
        now = asyncio.get_running_loop().time()
        self._credit = min(AT_ONCE, self._credit + (now - self._at) * PER_S)
        self._at = now
        if self._waiting or self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True

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


READING = ("GET", "HEAD", "OPTIONS")
"""Methods that change nothing."""


class LocalNames:
    """Refuses requests by a name that is not this machine's, and changes that pages of other sites send.

    A page may have its own name pointed to this machine (DNS rebinding), or send a form to it (cross-site request
    forgery).

    A service that knows nobody's token needs it: a browser sends the name of the page that asks.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        app = self._app
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            if not is_local_name(headers.get("host", "")):
                text = (
                    "a service without tokens answers to its address, its host name and localhost; ask by one of these"
                )
                app = problem(421, text)
            elif scope["method"] not in READING and is_cross_site(headers):
                app = problem(
                    403, "a page of another site sends this; a service without tokens takes no changes from it"
                )
        await app(scope, receive, send)


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


class NamedMissions:
    """Takes ``/missions/NAME`` off the path, and notes the name in a context variable: the request is about it."""

    def __init__(self, app: ASGIApp, named: ContextVar[str | None]) -> None:
        self._app, self._named = app, named

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As an ASGI application."""
        found = _ADDRESS.fullmatch(scope["path"]) if scope["type"] == "http" else None
        if found is None:
            await self._app(scope, receive, send)
            return
        before = self._named.set(found[1])
        try:
            await self._app({**scope, "path": found[2], "raw_path": found[2].encode()}, receive, send)
        finally:
            self._named.reset(before)


class Watch:
    """Counts answers that refuse, and writes the audit log.

    Plain ASGI: a middleware of Starlette's own base runs a task for every request.
    """

    def __init__(self, app: ASGIApp, state: ServiceState) -> None:
        self._app, self._state = app, state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and note the answer."""

        async def watched(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._note(scope, message["status"])
            await send(message)

        await self._app(scope, receive, watched)

    def _note(self, scope: Scope, status: int) -> None:
        address = (scope.get("client") or ("",))[0]
        if status >= 400:
            self._state.measures.refuse(status)
        if status == 401:
            self._state.audit.refuse_login(address)
        known = scope.get("state", {})
        if ACTOR in known:
            asked = f"?{scope['query_string'].decode('latin-1')}" if scope["query_string"] else ""
            action = f"{scope['method']} {scope['path']}{asked}"[:LONGEST_ACTION]
            self._state.audit.record(known[ACTOR], address, action, status, known.get(CONTENT, {}))
