"""What keeps a service running asks: is it well, and how much does it do."""

from fastapi import APIRouter, Depends
from fastapi.responses import JSONResponse, Response
from prometheus_client import CONTENT_TYPE_LATEST

from fcslam.cloud.service.authentication import Role
from fcslam.cloud.service.problems import problem
from fcslam.cloud.service.state import ServiceState
from fcslam.errors import StoreError


def operations_router(state: ServiceState) -> APIRouter:
    """Health, for everybody; measures, for viewers."""
    router = APIRouter(tags=["operations"])

    @router.get("/healthz")
    def get_health() -> JSONResponse:
        """200 while packets are taken in and the worker is ready for them, 503 otherwise."""
        try:
            state.mission.store.turn_count()
        except StoreError:
            return problem(503, "the mission cannot be read")
        if state.closing:
            return problem(503, "the service is stopping")
        if state.mission.worker.pid is None:
            return problem(503, "packets are taken in, but the worker is down")
        if not state.mission.worker.is_ready:
            return problem(503, "packets are taken in, but the worker is starting")
        return JSONResponse({"status": "ok"})

    @router.get("/metrics", dependencies=[Depends(state.require(Role.VIEWER, Role.ADMIN))])
    def get_metrics() -> Response:
        """Measures in Prometheus's text format."""
        return Response(state.measures.text(state.mission), media_type=CONTENT_TYPE_LATEST)

    return router
