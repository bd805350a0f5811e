"""Against web pages that read and write in the name of the user who opened them.

A page may have its own name pointed to this machine (DNS rebinding), or send a form to it (cross-site request forgery).
"""

from functools import cache
from ipaddress import ip_address
from socket import gethostname
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from fcslam.service.http.problems import problem

READING = ("GET", "HEAD", "OPTIONS")
"""Methods that change nothing."""


class LocalNames:
    """Refuses requests by a name that is not this machine's, and changes that pages of other sites send.

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
