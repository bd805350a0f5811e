"""What every request passes before its route, as plain ASGI: limits, names, counts and the audit log."""

import re
from contextvars import ContextVar
from functools import cache
from ipaddress import ip_address
from socket import gethostname
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fcslam.records import NAME
from fcslam.service.http.limits import CONTENT
from fcslam.service.http.problems import problem
from fcslam.service.http.state import ACTOR, ServiceState


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
    """Count answers that refuse, write the audit log, and let nobody keep answers that do not allow it.

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
                MutableHeaders(scope=message).setdefault("Cache-Control", "no-store")  # all but the page is data
            await send(message)

        await app(scope, receive, noting)

    return watch
