"""Routes for operators: health and metrics."""

from fastapi import APIRouter, HTTPException
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST

from fcslam.errors import StoreError
from fcslam.service.http.authentication import Role
from fcslam.service.http.responses import Health, content, refusals
from fcslam.service.http.state import ServiceState


def operations_router(state: ServiceState) -> APIRouter:
    """Health for everybody, metrics for viewers."""
    router = APIRouter(tags=["operations"])

    @router.get("/healthz", responses=refusals(503))
    def get_health() -> Health:
        """200 while the service takes packets and the worker is ready, 503 otherwise."""
        try:
            state.mission.store.applied()
        except StoreError as error:
            raise HTTPException(503, "the mission cannot be read") from error
        if state.closing:
            raise HTTPException(503, "the service is stopping")
        if state.mission.worker.pid is None:
            raise HTTPException(503, "the service takes packets, but the worker is down")
        if not state.mission.worker.is_ready:
            raise HTTPException(503, "the service takes packets, but the worker is starting")
        return Health()

    @router.get(
        "/metrics",
        dependencies=state.require(Role.VIEWER, Role.ADMIN),
        response_class=Response,
        responses={**refusals(401, 403, 503, 507), 200: content("text/plain")},
    )
    def get_metrics() -> Response:
        """Metrics in the Prometheus text format."""
        return Response(state.measures.text(state.mission), media_type=CONTENT_TYPE_LATEST)

    return router
