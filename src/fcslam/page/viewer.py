"""The page over a run that nobody can change: the routes of viewers alone, for this machine, without tokens."""

import asyncio
import itertools
import signal
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field

import uvicorn
from fastapi import FastAPI
from fastapi.params import Depends as Dependency

import fcslam
from fcslam.page.routes import page_router, report_router
from fcslam.runs.folder import identity
from fcslam.service.http.app import PREFIX, VIEWER_ROUTERS
from fcslam.service.http.authentication import Role
from fcslam.service.http.events import EventStream
from fcslam.service.http.middleware import LocalNames
from fcslam.service.http.problems import add_handlers
from fcslam.service.viewed_mission import ViewedMission

LOOK_S = 0.2
"""Between two looks for a new run folder."""
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
    """The page and what it asks; while it runs, its events follow the run folder."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        following = asyncio.create_task(_follow(state))
        yield
        following.cancel()

    app = FastAPI(
        title="fcslam", version=fcslam.__version__, openapi_url=None, redirect_slashes=False, lifespan=lifespan
    )
    add_handlers(app)
    for make in VIEWER_ROUTERS:
        app.include_router(make(state), prefix=PREFIX)
    app.include_router(page_router())
    app.include_router(report_router(state))
    app.add_middleware(LocalNames)
    return app


async def _follow(state: ReadOnly) -> None:
    shown = _newest(state)
    for number in itertools.count(1):
        while shown == (newest := _newest(state)):
            await asyncio.sleep(LOOK_S)
        shown = newest
        state.events.publish("live", number)


def _newest(state: ReadOnly) -> tuple[int, int] | None:
    folder = state.mission.run_folder
    with suppress(FileNotFoundError):  # another one is about to replace it
        return None if folder is None else identity(folder)
    return None


def run_viewer(app: FastAPI, listening: socket.socket) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    # requests that fail say so to the page; an open page is a request that never ends by itself
    config = uvicorn.Config(
        app, log_level="critical", ws="none", server_header=False, timeout_graceful_shutdown=LAST_ANSWERS_S
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])
