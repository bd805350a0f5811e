"""The page: its files, which hold no data of a mission, so nobody needs a token for them, and a viewer of a run."""

import asyncio
import signal
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress

import uvicorn
from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool

from fcslam.page import ASSETS, MODULES
from fcslam.page.report import ReadOnly, report_html, viewer_app
from fcslam.service.authentication import VIEWERS
from fcslam.service.http.app import PREFIX
from fcslam.service.http.middleware import local_names
from fcslam.service.http.responses import unless_known
from fcslam.service.http.state import ViewerState
from fcslam.service.viewed_mission import ViewedMission

FILES = {
    "/": ("index.html", "text/html"),
    **{f"/{name}": (name, "text/javascript") for name in MODULES},
    "/page.css": ("page.css", "text/css"),
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


def page_router() -> APIRouter:
    """The page at ``/``, its script and its style."""
    router = APIRouter(include_in_schema=False)
    for path, (name, media_type) in FILES.items():
        router.add_api_route(path, _sender(name, media_type), methods=["GET"], response_class=Response)
    return router


def report_router(state: ViewerState) -> APIRouter:
    """The report of the open mission, for viewers."""
    router = APIRouter(include_in_schema=False, dependencies=state.require(*VIEWERS))

    turn = asyncio.Lock()  # a report takes much memory, and the threads are needed for packets

    @router.get(f"{PREFIX}/report.html")
    async def get_report() -> Response:
        """The page as one file."""
        async with turn:
            report = await run_in_threadpool(lambda: asyncio.run(report_html(state.mission)))
        headers = {"Content-Disposition": 'attachment; filename="report.html"', "X-Content-Type-Options": "nosniff"}
        return Response(report, media_type="text/html", headers=headers)

    return router


def run_page(mission: ViewedMission) -> FastAPI:
    """The page over a run that nobody can change, and what it asks: for this machine, without tokens."""
    state = ReadOnly(mission)
    app = viewer_app(state)
    app.include_router(page_router())
    app.include_router(report_router(state))
    app.add_middleware(local_names)
    return app


def serve_page(app: FastAPI, listening: socket.socket) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    # requests that fail say so to the page; an open page is a request that never ends by itself
    config = uvicorn.Config(app, log_level="critical", ws="none", server_header=False, timeout_graceful_shutdown=1)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])


def _sender(name: str, media_type: str) -> Callable[[Request], Awaitable[Response]]:
    content = (ASSETS / name).read_bytes()

    async def send(request: Request) -> Response:
        return unless_known(request, content, media_type, **HEADERS)

    return send
