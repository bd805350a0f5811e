"""Routes for operators: health, readiness and metrics."""

from typing import Annotated

from fastapi import APIRouter, HTTPException, Query
from fastapi.responses import JSONResponse, Response
from prometheus_client import CONTENT_TYPE_LATEST

from fcslam.errors import StoreError
from fcslam.service.audit_log import AuditEntry
from fcslam.service.http.authentication import Role
from fcslam.service.http.problems import problem
from fcslam.service.http.responses import file_of, refusals
from fcslam.service.http.state import ServiceState

LARGEST_BACKLOG = 200
"""Packets that may wait for a worker that is ready: fifty robots send as many in two seconds."""


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

    @router.get("/readyz", response_model=dict[str, str | int], responses=refusals(503))
    def get_readiness() -> dict[str, str | int] | JSONResponse:
        """200 while the worker follows what robots send, 503 while it starts or catches up."""
        backlog = state.mission.intake.ready_count() - state.mission.worker.applied
        if state.closing or not state.mission.worker.is_ready:
            return problem(
                503, "the worker is stopping" if state.closing else "the worker is starting", backlog=backlog
            )
        if backlog > LARGEST_BACKLOG:
            return problem(503, f"the worker is catching up: {backlog} packets have no effect yet", backlog=backlog)
        return {"status": "ready", "backlog": backlog}

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
