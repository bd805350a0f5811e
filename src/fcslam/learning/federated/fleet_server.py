"""The operations of learning: robots fetch requests and bring replies, and nothing else can be asked.

    POST /api/v1/robots/ROBOT/learning/next            204, or a request with its number in a header; waits for one
    POST /api/v1/robots/ROBOT/learning/reply/NUMBER    204; the reply to a request

They are of the process in which the fleet learns; the service checks who asks before it passes a request (``relay``).
"""

import asyncio
import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from fcslam.learning.federated.fleet_grid import ONLINE_S, FleetGrid

PATH: Final = "/api/v1/robots/{robot}/learning"
NUMBER_HEADER: Final = "x-fcslam-request"
"""Number of the request in the body."""
LONG_POLL_S: Final = 10.0
"""Time for which the server holds a robot's question for a request."""
POLL_S: Final = 0.1
MAX_OPEN_REQUESTS: Final = 4
"""Requests of one robot at the same time."""
MAX_UNWANTED_BYTES: Final = 64 * 2**20
"""A robot that is still sending would not see an answer, so a reply that comes too late is read to here."""
ANSWER_S: Final = ONLINE_S
"""Time for the answer to a request."""
RETRY_S: Final = 3.0
"""Time after which something is tried again."""


def fleet_app(grid: FleetGrid) -> Starlette:
    """The operations as an application for an ASGI server."""
    open_requests: Counter[str] = Counter()

    def limited(handler: Callable[[Request, str], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
        """The handler, for as many robots as the fleet has room for, and not too many times at once."""

        async def handle(request: Request) -> Response:
            robot = request.path_params["robot"]
            if not grid.admits(robot) or open_requests[robot] >= MAX_OPEN_REQUESTS:
                return PlainTextResponse("too many robots, or requests of this robot", 429)
            open_requests[robot] += 1
            try:
                return await handler(request, robot)
            except ClientDisconnect:
                return Response(status_code=400)
            finally:
                open_requests[robot] -= 1

        return handle

    async def next_request(_request: Request, robot: str) -> Response:
        end = time.monotonic() + LONG_POLL_S
        while time.monotonic() < end:
            found = grid.next_request(robot)
            if found is not None:
                return Response(found[1], headers={NUMBER_HEADER: str(found[0])})
            await asyncio.sleep(POLL_S)
        return Response(status_code=204)

    async def reply(request: Request, robot: str) -> Response:
        number = int(request.path_params["number"])
        limit, size, body = grid.reply_limit(robot, number), 0, bytearray()
        async for part in request.stream():
            size += len(part)
            if limit:
                body += part
            if size > (limit or MAX_UNWANTED_BYTES):
                reason = f"a reply of more than {limit} bytes"
                grid.refuse_reply(robot, number, reason)
                return PlainTextResponse(reason, 413, headers={"connection": "close"})
        if limit and await run_in_threadpool(grid.store_reply, robot, number, bytes(body)):
            return Response(status_code=204)
        return PlainTextResponse("nobody waits for this reply", 410)

    operations = {"next": next_request, "reply/{number:int}": reply}
    return Starlette(
        routes=[Route(f"{PATH}/{name}", limited(handler), methods=["POST"]) for name, handler in operations.items()]
    )


@contextlib.contextmanager
def listening(grid: FleetGrid, listener: socket.socket) -> Iterator[None]:
    """Serve the operations in a thread while the block runs."""
    config = uvicorn.Config(
        fleet_app(grid), log_level="critical", lifespan="off", ws="none", timeout_graceful_shutdown=2
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([listener],), name="fleet server", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.should_exit = True
        thread.join()
