"""The ASGI application; what it needs is given to it."""

import json
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

from fastapi import APIRouter, FastAPI
from starlette.responses import Response

import fcslam
from fcslam.service.http.decisions import decision_router
from fcslam.service.http.events import event_router
from fcslam.service.http.fleet import fleet_router
from fcslam.service.http.joint_maps import joint_map_router
from fcslam.service.http.maps import map_router
from fcslam.service.http.middleware import UnauthenticatedLimit, local_names, named_missions, watched
from fcslam.service.http.missions import mission_router
from fcslam.service.http.operations import operations_router
from fcslam.service.http.problems import add_handlers
from fcslam.service.http.robots import detector_router, robot_router
from fcslam.service.http.state import ServiceState

PREFIX = "/api/v1"
VIEWER_ROUTERS = (fleet_router, map_router, event_router)
"""Routes of the page; they read."""
ROUTERS = (robot_router, joint_map_router, detector_router, mission_router, decision_router)


def described(app: FastAPI) -> dict[str, Any]:
    """The interface, in OpenAPI 3.1, without the refusal that FastAPI adds to every route: this service words it."""
    description = app.openapi()
    for operation in (one for path in description["paths"].values() for one in path.values()):
        operation["responses"].pop("422", None)
    for unused in ("HTTPValidationError", "ValidationError"):
        description["components"]["schemas"].pop(unused, None)
    return description


def create_app(
    state: ServiceState,
    more: Sequence[APIRouter] = (),
    only_local_names: bool = False,
    named: ContextVar[str | None] | None = None,
) -> FastAPI:
    """The service; ``more`` routers come from rooms that this one does not know. Closes the missions at its end.

    With ``only_local_names``, it refuses requests that do not name the machine by an address or as localhost. With
    ``named``, requests may name a mission (``named_missions``).
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        state.close()
        state.audit.flush()
        state.missions.close()

    app = FastAPI(
        title="fcslam",
        version=fcslam.__version__,
        docs_url=None,
        redoc_url=None,
        openapi_url=None,  # its route would write the description anew for each request
        redirect_slashes=False,  # a redirect repeats whatever Host the request names
        lifespan=lifespan,
    )
    add_handlers(app)
    for make in (*ROUTERS, *VIEWER_ROUTERS):
        app.include_router(make(state), prefix=PREFIX)
    app.include_router(operations_router(state))
    description = cache(lambda: json.dumps(described(app), ensure_ascii=False, separators=(",", ":")).encode())
    app.add_route(
        "/openapi.json", lambda _: Response(description(), media_type="application/json"), include_in_schema=False
    )
    for router in more:
        app.include_router(router)
    if only_local_names:
        app.add_middleware(local_names)
    app.add_middleware(watched, state=state)
    app.add_middleware(UnauthenticatedLimit, is_known=state.is_known)
    if named is not None:
        app.add_middleware(named_missions, named=named)
    return app
