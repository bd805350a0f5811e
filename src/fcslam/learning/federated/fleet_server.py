"""The operations of learning: robots fetch requests and bring replies, and nothing else can be asked.

    POST /api/v1/robots/ROBOT/learning/next            204, or a request with its number in a header; waits for one
    POST /api/v1/robots/ROBOT/learning/alive           204; a robot at work shows that it is still there
    POST /api/v1/robots/ROBOT/learning/reply/NUMBER    204; the reply to a request

A robot shows its token or its certificate, as for its packets; anybody else gets 401 before the body is read. No
operation starts a run, adds a token or names a program: the operator does this on the server's command line.
"""

import asyncio
import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.messages import printable_line
from fcslam.service.http.authentication import Authenticator, Identity, Role
from fcslam.service.http.protocol import GuardedProtocol, GuardedServer

PATH: Final = "/api/v1/robots/{robot}/learning"
NUMBER_HEADER: Final = "x-fcslam-request"
"""Number of the request in the body."""
LONG_POLL_S: Final = 10.0
"""Time for which the server holds a robot's question for a request."""
POLL_S: Final = 0.1
MAX_OPEN_REQUESTS: Final = 4
"""Requests of one robot at the same time. A robot needs two: one at work, and the sign of life."""
WAIT_S: Final = 5.0
"""Time after which a round is tried again that could not be completed."""
START_S: Final = 30.0
STOP_S: Final = 5.0
MAX_NOTICES: Final = 100
"""Different refusals that are reported, so that nobody can flood the log."""
MAX_UNWANTED_BYTES: Final = 64 * 2**20
"""A robot may send so much too late before the server hangs up."""
_UNWANTED: Final = "nobody waits for this reply"

OnNotice = Callable[[str], None]


class FleetApp:
    """The operations of the port. Its methods are the handlers.

    An open ``authenticator`` believes the name in the path. ``on_notice`` is called with one line for each kind of
    refused request, from the thread of the server.
    """

    def __init__(self, grid: FleetGrid, authenticator: Authenticator, on_notice: OnNotice) -> None:
        self._grid, self._authenticator, self._on_notice = grid, authenticator, on_notice
        self._open: Counter[str] = Counter()
        self._notices: set[str] = set()
        self._is_closing = False

    def close(self) -> None:
        """Let no robot wait for a request any longer."""
        self._is_closing = True

    def asgi(self) -> Starlette:
        """The application for an ASGI server."""
        operations = {"next": self._next, "alive": self._alive, "reply/{number:int}": self._reply}
        routes = [
            Route(f"{PATH}/{operation}", self._guarded(handler), methods=["POST"])
            for operation, handler in operations.items()
        ]
        app = Starlette(routes=routes, exception_handlers={404: self._unknown, 405: self._unknown})
        app.router.redirect_slashes = False  # a redirect repeats whatever Host the request names
        return app

    def _guarded(
        self, handler: Callable[[Request, str], Awaitable[Response]]
    ) -> Callable[[Request], Awaitable[Response]]:
        """The handler, for robots of the fleet only, and not too many times at once."""

        async def handle(request: Request) -> Response:
            robot = request.path_params["robot"]
            if not self._authenticator.is_open and self._who(request) != Identity(robot, Role.ROBOT):
                return self._refusal(request, 401, f"it has no token of robot {robot}")
            if not self._grid.admits(robot):
                return self._refusal(request, 401, f"the fleet has no room for robot {robot}")
            if self._open[robot] >= MAX_OPEN_REQUESTS:
                return self._refusal(request, 429, f"{robot} has too many requests open")
            self._open[robot] += 1
            try:
                return await handler(request, robot)
            except ClientDisconnect:
                return Response(status_code=400)
            finally:
                self._open[robot] -= 1

        return handle

    def _who(self, request: Request) -> Identity | None:
        tls = request.scope.get("extensions", {}).get("tls", {})
        return self._authenticator.who(request.headers.get("authorization"), tls.get("client_cert_name"))

    async def _next(self, _request: Request, robot: str) -> Response:
        end = time.monotonic() + LONG_POLL_S
        while time.monotonic() < end and not self._is_closing:
            found = self._grid.next_request(robot)
            if found is not None:
                return Response(found.data, headers={NUMBER_HEADER: str(found.number)})
            await asyncio.sleep(POLL_S)
        return Response(status_code=204)

    async def _alive(self, _request: Request, robot: str) -> Response:
        self._grid.mark_online(robot)
        return Response(status_code=204)

    async def _reply(self, request: Request, robot: str) -> Response:
        self._grid.mark_online(robot)
        number = int(request.path_params["number"])
        limit = self._grid.reply_limit(robot, number)
        if limit == 0:
            await self._drain(request)
            return PlainTextResponse(_UNWANTED, 409)
        body = await self._body(request, limit)
        if body is None:
            reason = f"a reply of more than {limit} bytes"
            self._grid.refuse_reply(robot, number, reason)
            return self._refusal(request, 413, f"{robot}: {reason}")
        is_taken = await run_in_threadpool(self._grid.store_reply, robot, number, body)
        return Response(status_code=204) if is_taken else PlainTextResponse(_UNWANTED, 409)

    async def _body(self, request: Request, limit: int) -> bytes | None:
        """The body, read no further than ``limit`` bytes; None if it is longer."""
        body = bytearray()
        async for part in request.stream():
            body += part
            if len(body) > limit:
                return None
        return bytes(body)

    async def _drain(self, request: Request) -> None:
        """Read a body that nobody wants: a robot that is still sending would not see the answer."""
        size = 0
        async for part in request.stream():
            size += len(part)
            if size > MAX_UNWANTED_BYTES:
                return

    async def _unknown(self, request: Request, _error: Exception) -> Response:
        return self._refusal(request, 404, "nobody starts a run or runs an app here; robots fetch requests")

    def _refusal(self, request: Request, status: int, reason: str) -> Response:
        host = "?" if request.client is None else request.client.host
        line = printable_line(f"refused: {request.method} {request.url.path} from {host}: {reason}")
        if line not in self._notices and len(self._notices) < MAX_NOTICES:
            self._notices.add(line)
            self._on_notice(line)
        return PlainTextResponse(reason, status, headers={"connection": "close"})


@contextlib.contextmanager
def open_port(
    listener: socket.socket, tls: tuple[Path, Path] | None, authenticator: Authenticator, on_notice: OnNotice
) -> Iterator[FleetGrid]:
    """Let robots fetch requests while the block runs; arguments as for ``FleetApp`` and ``listening``."""
    grid = FleetGrid()
    with listening(FleetApp(grid, authenticator, on_notice), listener, tls):
        yield grid


def waiting(on_notice: OnNotice) -> Callable[[str], None]:
    """A function that says the reason to wait, and waits."""

    def wait(reason: str) -> None:
        on_notice(f"waiting: {reason}")
        time.sleep(WAIT_S)

    return wait


@contextlib.contextmanager
def listening(app: FleetApp, listener: socket.socket, tls: tuple[Path, Path] | None = None) -> Iterator[None]:
    """Serve the operations in a thread while the block runs.

    ``tls``: PEM files of this machine's certificate and its key; None for no encryption.
    """
    server = GuardedServer(
        uvicorn.Config(
            app.asgi(),
            loop="asyncio",
            http=GuardedProtocol,
            ssl_certfile=None if tls is None else tls[0],
            ssl_keyfile=None if tls is None else tls[1],
            log_level="critical",
            lifespan="off",
            ws="none",
            server_header=False,
            timeout_graceful_shutdown=2,
        )
    )
    thread = threading.Thread(target=server.run, args=([listener],), name="fleet server", daemon=True)
    thread.start()
    end = time.monotonic() + START_S
    while not server.started and thread.is_alive() and time.monotonic() < end:
        time.sleep(0.02)
    try:
        yield
    finally:
        app.close()
        server.should_exit = True
        thread.join(STOP_S)
