"""Events as they happen, as server-sent events."""

import asyncio
import json
from collections.abc import AsyncIterator

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import Response, StreamingResponse

from fcslam.service.http.authentication import Role
from fcslam.service.http.responses import content, refusals
from fcslam.service.http.state import ViewerState

EVENTS = "text/event-stream"
VIEWERS = Role.VIEWER, Role.ADMIN
BEAT_S = 5.0
"""Something comes at least so often, so that a client notices a dead connection."""
MOST_STREAMS = 200
"""Streams at a time: each costs the process a look four times a second."""
LOOK_S = 0.25
"""How often a stream asks whether it may go on."""


def event_router(state: ViewerState) -> APIRouter:
    """One stream."""
    router = APIRouter(tags=["viewers"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    open_streams = 0

    async def lines(request: Request) -> AsyncIterator[str]:
        nonlocal open_streams
        open_streams += 1
        loop, events = asyncio.get_running_loop(), state.events.watch()
        said_s, following = loop.time(), asyncio.ensure_future(anext(events))
        try:
            while state.admits(request, *VIEWERS):
                await asyncio.wait({following}, timeout=LOOK_S)
                if following.done():
                    event = following.result()
                    said_s, following = loop.time(), asyncio.ensure_future(anext(events))
                    yield f"event: {event.kind}\ndata: {json.dumps({'number': event.number})}\n\n"
                elif loop.time() - said_s >= BEAT_S:
                    said_s = loop.time()
                    yield ": nothing new\n\n"
        finally:
            open_streams -= 1
            following.cancel()

    @router.get("/events", response_class=Response, responses={**refusals(429), 200: content(EVENTS)})
    async def get_events(request: Request) -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written. A comment comes at least every 5 s.

        The stream ends when the service stops, or when the token is no longer valid.
        """
        if open_streams >= MOST_STREAMS:
            raise HTTPException(
                429, f"{MOST_STREAMS} streams of events are open, the limit; close one", {"Retry-After": "60"}
            )
        return StreamingResponse(lines(request), media_type=EVENTS)

    return router
