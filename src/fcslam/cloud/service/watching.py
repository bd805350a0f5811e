"""Events as they happen, as server-sent events."""

import json
from collections.abc import AsyncIterator

from fastapi import APIRouter, Depends
from fastapi.responses import StreamingResponse

from fcslam.cloud.service.authentication import Role
from fcslam.cloud.service.state import ServiceState


def event_router(state: ServiceState) -> APIRouter:
    """One stream."""
    router = APIRouter(tags=["viewers"], dependencies=[Depends(state.require(Role.VIEWER, Role.ADMIN))])

    async def lines() -> AsyncIterator[str]:
        async for event in state.events.watch():
            yield f"event: {event.kind}\ndata: {json.dumps({'number': event.number})}\n\n"

    @router.get("/events")
    async def get_events() -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written."""
        return StreamingResponse(lines(), media_type="text/event-stream")

    return router
