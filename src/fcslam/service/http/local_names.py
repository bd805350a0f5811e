"""Against DNS rebinding: a web page whose own name was pointed to this machine reads and writes in its user's name."""

from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from fcslam.service.http.problems import problem


class LocalNames:
    """Refuses requests that name this machine neither by an address nor as localhost.

    A service that knows nobody's token needs it: a browser sends the name of the page that asks.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] == "http" and not is_local_name(Headers(scope=scope).get("host", "")):
            text = "a service without tokens answers to localhost and to addresses only; ask it by one of these"
            await problem(421, text)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


def is_local_name(host: str) -> bool:
    """Whether a Host header is an IP address or localhost, with or without a port."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or bool(ip_address(name))
    except ValueError:
        return False
