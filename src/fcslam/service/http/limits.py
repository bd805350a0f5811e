"""Limits of requests: how many of whom at a time, and their sizes."""

import asyncio
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from fastapi import HTTPException, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fcslam.service.authentication import Identity
from fcslam.service.http.responses import content

LONGEST_JSON_BYTES = 64 * 2**10

CONTENT = "content"
"""Key of the body in the state of a request, for the audit log."""

PER_S, AT_ONCE = 100.0, 20
"""Requests without a known token that are answered, on average and at once: each takes a millisecond of the process."""
KNOWN_PER_S, KNOWN_AT_ONCE = 200.0, 8
"""The same of one identity. A robot makes ten a second at most, a page a hundred tiles when it is opened."""
PATIENCE_S = 1.0
"""A request waits this long before it takes the place of one of the same identity whose body has not come."""
WHO, WAITING, CONNECTION = "who", "waiting", "connection"
"""Keys in the state of a request: its ``Identity`` or None, the future of its turn while it waits, and its
``GuardedProtocol``.
"""

_Model = TypeVar("_Model", bound=BaseModel)


class TurnQueue:
    """Requests of one identity, or of all without a known token. Some are in progress, the others wait for their turn.

    A connection has one request at a time, so a client that sends without pause slows down itself. Turns go round the
    addresses, so that one address cannot take those of the others.
    """

    def __init__(self, places: int, patience_s: float) -> None:
        self._free, self._patience_s = places, patience_s
        self._begun: dict[object, tuple[float, Any]] = {}
        """When each request in progress began, and its connection, the oldest first."""
        self._waiting: dict[str, dict[asyncio.Future[bool], None]] = {}
        """By address, that of the next turn first."""

    async def begin(self, place: object, address: str, state: dict[str, Any]) -> bool:
        """Wait for the turn; false if the connection is closed before."""
        if self._free:
            self._free -= 1
        else:
            loop = asyncio.get_running_loop()
            turn = state[WAITING] = loop.create_future()
            self._waiting.setdefault(address, {})[turn] = None
            late = loop.call_later(self._patience_s, self._close_unfinished)
            try:
                if not await turn:
                    self._remove(address, turn)
                    return False
            finally:
                late.cancel()
                del state[WAITING]
        self._begun[place] = time.monotonic(), state.get(CONNECTION)
        return True

    def end(self, place: object) -> None:
        """The request is answered: the next address that waits has its turn."""
        if self._begun.pop(place, None) is None:
            return
        for address, turns in list(self._waiting.items()):
            for turn in list(turns):
                self._remove(address, turn)
                if not turn.done():
                    turn.set_result(True)
                    return
        self._free += 1

    def _remove(self, address: str, turn: asyncio.Future[bool]) -> None:
        """Let a request wait no longer; those of its address are the last ones now."""
        turns = self._waiting.pop(address, {})
        turns.pop(turn, None)
        if turns:
            self._waiting[address] = turns

    def _close_unfinished(self) -> None:
        """Close the oldest request whose body has not come in all this time."""
        for began, connection in self._begun.values():
            if connection and connection.is_unfinished and time.monotonic() >= began + self._patience_s:
                connection.close()
                return


class RequestLimits:
    """Limits requests by identity and address, so that no token and no stranger can delay others."""

    def __init__(
        self,
        app: ASGIApp,
        who: Callable[[Scope], Identity | None],
        is_open: Callable[[], bool] = lambda: False,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """``is_open``: whether nobody has an identity, and whoever asks may do everything; then there is no limit."""
        self._app, self._who, self._is_open, self._patience_s = app, who, is_open, patience_s
        self._queues: dict[str, TurnQueue] = {}
        """By the name of the identity; the empty name has all requests without a known token."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when it is its turn."""
        if scope["type"] != "http" or self._is_open():
            await self._app(scope, receive, send)
            return
        state, place = scope.setdefault("state", {}), object()
        who = state[WHO] = self._who(scope)
        name, places, per_s = ("", AT_ONCE, PER_S) if who is None else (who.name, KNOWN_AT_ONCE, KNOWN_PER_S)
        queue = self._queues.setdefault(name, TurnQueue(places, self._patience_s))
        if not await queue.begin(place, (scope.get("client") or ("",))[0], state):
            return

        loop = asyncio.get_running_loop()
        end = partial(loop.call_at, loop.time() + places / per_s, queue.end, place)
        if who is None:
            end()  # a stranger takes no place for longer

        async def sending(message: Message) -> None:
            end()  # a long answer, as a stream of events, takes no place
            await send(message)

        try:
            await self._app(scope, receive, sending)
        finally:
            end()


async def read_body(request: Request, longest: int) -> bytes:
    """A request's body, refused (HTTPException 413) before more than ``longest`` bytes of it are read."""
    announced = request.headers.get("content-length", "0")
    too_long = HTTPException(413, f"the body is over {longest} bytes; send less at once")
    if announced.isdecimal() and int(announced) > longest:
        raise too_long
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > longest:
            raise too_long
    return bytes(body)


async def read_json(request: Request, model: type[_Model]) -> _Model:
    """A request's body as ``model``. For handlers: FastAPI itself would read it all before it asks who sends it.

    Refuses: 413 (HTTPException) over 64 KiB, 400 (RequestValidationError) what is no such thing.
    """
    body = await read_body(request, LONGEST_JSON_BYTES)
    try:
        read = model.model_validate_json(body)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        raise RequestValidationError([{**one, "loc": ("body", *one["loc"])} for one in found]) from error
    setattr(request.state, CONTENT, read.model_dump())
    return read


def json_body(model: type[BaseModel]) -> dict[str, Any]:
    """The OpenAPI description of a body that ``read_json`` reads."""
    return {"requestBody": {"required": True, **content("application/json", model=model.model_json_schema())}}
