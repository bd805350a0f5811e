"""Events as they happen, as server-sent events."""

import json
from collections.abc import AsyncIterator

from fastapi import APIRouter
from fastapi.responses import Response, StreamingResponse

from fcslam.service.http.authentication import Role
from fcslam.service.http.responses import content, refusals
from fcslam.service.http.state import ViewerState

EVENTS = "text/event-stream"


def event_router(state: ViewerState) -> APIRouter:
    """One stream."""
    router = APIRouter(
        tags=["viewers"], dependencies=state.require(Role.VIEWER, Role.ADMIN), responses=refusals(401, 403, 503)
    )

    async def lines() -> AsyncIterator[str]:
        async for event in state.events.watch():
            yield f"event: {event.kind}\ndata: {json.dumps({'number': event.number})}\n\n"

    @router.get("/events", response_class=Response, responses={200: content(EVENTS)})
    async def get_events() -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written."""
        return StreamingResponse(lines(), media_type=EVENTS)

    return router
