"""Addresses of one of several missions: what follows ``/missions/NAME`` means that mission, whichever is open."""

import re
from contextvars import ContextVar
from typing import Final

from starlette.types import ASGIApp, Receive, Scope, Send

from fcslam.records import NAME

_ADDRESS: Final = re.compile(rf"/missions/({NAME.pattern})(/(?!healthz$|readyz$).*)", re.ASCII)


class NamedMissions:
    """Takes the mission's name off the path, and notes it in a context variable for the request."""

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
