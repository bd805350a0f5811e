"""The ASGI application, and its routes for operators; what it needs is given to it."""

import json
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from contextvars import ContextVar
from functools import cache
from typing import Annotated, Any

from fastapi import APIRouter, FastAPI, HTTPException, Query
from fastapi.responses import JSONResponse, Response
from prometheus_client import CONTENT_TYPE_LATEST

import fcslam
from fcslam.errors import StoreError
from fcslam.service.audit_log import AuditEntry
from fcslam.service.authentication import Role
from fcslam.service.http.administration import administration_router
from fcslam.service.http.fleet import event_router, fleet_router
from fcslam.service.http.joint_maps import joint_map_router
from fcslam.service.http.limits import RequestLimits
from fcslam.service.http.maps import map_router
from fcslam.service.http.middleware import local_names, named_missions, watched
from fcslam.service.http.missions import mission_router
from fcslam.service.http.problems import add_handlers, problem
from fcslam.service.http.responses import file_of, refusals
from fcslam.service.http.robots import detector_router, robot_router
from fcslam.service.http.state import ServiceState
from fcslam.service.viewed_mission import map_lag

LARGEST_BACKLOG = 200
"""Packets that may wait for a worker that is ready: fifty robots send as many in two seconds."""
PREFIX = "/api/v1"
VIEWER_ROUTERS = (fleet_router, map_router, event_router)
"""Routes of the page; they read."""
ROUTERS = (robot_router, joint_map_router, detector_router, mission_router, administration_router)


def operations_router(state: ServiceState) -> APIRouter:
    """Health and readiness for everybody, metrics for viewers."""
    router = APIRouter(tags=["operations"])

    @router.get("/healthz", responses=refusals(503))
    def get_health() -> dict[str, str]:
        """200 while the service takes packets and the worker is ready, 503 otherwise."""
        try:
            state.mission.store.applied()
        except StoreError as error:
            raise HTTPException(503, "the mission cannot be read") from error
        if state.closing:
            raise HTTPException(503, "the service is stopping")
        worker = state.mission.worker
        if not worker.is_ready:
            is_down = "down" if worker.pid is None else "starting"
            raise HTTPException(503, f"the service takes packets, but the worker is {is_down}")
        return {"status": "ok"}

    @router.get("/readyz", response_model=dict[str, str | float], responses=refusals(503))
    def get_readiness() -> dict[str, str | float] | JSONResponse:
        """200 while the worker follows what robots send, 503 while it starts or catches up.

        ``lacking_packets``, ``lacking_sessions``, ``lacking_s``: what the drawn map lacks, as ``/api/v1/fleet`` has it.
        """
        backlog = state.mission.intake.ready_count() - state.mission.worker.applied
        if state.closing or not state.mission.worker.is_ready:
            return problem(
                503, "the worker is stopping" if state.closing else "the worker is starting", backlog=backlog
            )
        if backlog > LARGEST_BACKLOG:
            return problem(503, f"the worker is catching up: {backlog} packets have no effect yet", backlog=backlog)
        lag = map_lag(state.mission, time.time())
        lacking = {f"lacking_{name}": number for name, number in lag._asdict().items()}
        return {"status": "ready", "backlog": backlog, **lacking}

    @router.get("/api/v1/audit", dependencies=state.require(Role.ADMIN), responses=refusals(400, 401, 403, 503))
    def get_audit(limit: Annotated[int, Query(ge=1, le=10_000)] = 100) -> list[AuditEntry]:
        """The newest lines of the audit log: who did what, and how many logins were refused."""
        return state.audit.newest(limit)

    as_viewer, metrics = state.require(Role.VIEWER, Role.ADMIN), file_of("text/plain", refused=(401, 403, 503, 507))

    @router.get("/metrics", dependencies=as_viewer, **metrics)
    def get_metrics() -> Response:
        """Metrics in the Prometheus text format."""
        return Response(state.measures.text(state.mission), media_type=CONTENT_TYPE_LATEST)

    return router


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
    app.add_middleware(RequestLimits, who=state.who, is_open=lambda: state.authenticator.is_open)
    if named is not None:
        app.add_middleware(named_missions, named=named)
    return app
