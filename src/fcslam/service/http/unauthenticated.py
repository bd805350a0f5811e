"""One budget for all requests without a known token, so that they cannot delay the robots.

Each waits for its turn, and a connection has one request at a time: so clients that send without pause slow down
themselves. Turns go round the addresses, so that one address cannot take those of the others.
"""

import asyncio
from collections import deque
from collections.abc import Callable

from starlette.types import ASGIApp, Receive, Scope, Send

from fcslam.service.http.problems import problem

PER_S, AT_ONCE = 100.0, 20.0
"""Requests that are answered, on average and at once: each takes about a millisecond of the process."""
MOST_WAITING = 4096
"""Requests that wait for a turn; of more, one of the address that has most is refused."""
WAITING = "waiting"
"""Key in the state of a request that waits: its connection may be closed to make room."""


class UnauthenticatedLimit:
    """Lets the requests without a known token through at a limited rate; others pass at once."""

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
