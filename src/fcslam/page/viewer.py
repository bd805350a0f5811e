"""The page over a run that nobody can change: the routes of viewers alone, for this machine, without tokens."""

import signal
import socket
from contextlib import suppress
from dataclasses import dataclass, field

import uvicorn
from fastapi import FastAPI
from fastapi.params import Depends as Dependency

import fcslam
from fcslam.page.routes import page_router, report_router
from fcslam.service.http.app import PREFIX, VIEWER_ROUTERS
from fcslam.service.http.authentication import Role
from fcslam.service.http.events import EventStream
from fcslam.service.http.middleware import LocalNames
from fcslam.service.http.problems import add_handlers
from fcslam.service.viewed_mission import ViewedMission

LAST_ANSWERS_S = 1
"""Time for requests in progress when the viewer ends."""


@dataclass(frozen=True, slots=True)
class ReadOnly:
    """A ``ViewerState`` without roles: whoever reaches it may read, and nobody may change anything."""

    mission: ViewedMission
    events: EventStream = field(default_factory=EventStream)
    read_only: bool = True
    learning: None = None

    def require(self, *_: Role) -> list[Dependency]:
        """Nothing."""
        return []

    def admits(self, *_: object) -> bool:
        """Everybody."""
        return True


def viewer_app(state: ReadOnly) -> FastAPI:
    """The page and what it asks."""
    app = FastAPI(title="fcslam", version=fcslam.__version__, openapi_url=None, redirect_slashes=False)
    add_handlers(app)
    for make in VIEWER_ROUTERS:
        app.include_router(make(state), prefix=PREFIX)
    app.include_router(page_router())
    app.include_router(report_router(state))
    app.add_middleware(LocalNames)
    return app


def run_viewer(app: FastAPI, listening: socket.socket) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    # requests that fail say so to the page; an open page is a request that never ends by itself
    config = uvicorn.Config(
        app, log_level="critical", ws="none", server_header=False, timeout_graceful_shutdown=LAST_ANSWERS_S
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])
