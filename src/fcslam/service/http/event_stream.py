"""Events as they happen, as server-sent events."""

import asyncio
import json
from collections.abc import AsyncIterator

from fastapi import APIRouter, Request
from fastapi.responses import StreamingResponse

from fcslam.service.http.authentication import Role
from fcslam.service.http.responses import file_of, refusals
from fcslam.service.http.state import ViewerState

EVENTS = "text/event-stream"
VIEWERS = Role.VIEWER, Role.ADMIN
BEAT_S = 5.0
"""Something comes at least so often, so that a client notices a dead connection."""
MOST_STREAMS = 200
"""Streams at a time: each costs the process a look four times a second. A further one ends the oldest, whose client
asks again if it is still there."""
LOOK_S = 0.25
"""How often a stream asks whether it may go on."""


def event_router(state: ViewerState) -> APIRouter:
    """One stream."""
    router = APIRouter(tags=["viewers"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    streams: list[object] = []

    async def lines(request: Request) -> AsyncIterator[str]:
        mine = object()
        streams.append(mine)
        del streams[:-MOST_STREAMS]
        loop, events = asyncio.get_running_loop(), state.events.watch()
        said_s, following = loop.time(), asyncio.ensure_future(anext(events))
        try:
            while mine in streams and state.admits(request, *VIEWERS):
                await asyncio.wait({following}, timeout=LOOK_S)
                if following.done():
                    event = following.result()
                    said_s, following = loop.time(), asyncio.ensure_future(anext(events))
                    yield f"event: {event.kind}\ndata: {json.dumps({'number': event.number})}\n\n"
                elif loop.time() - said_s >= BEAT_S:
                    said_s = loop.time()
                    yield ": nothing new\n\n"
        finally:
            if mine in streams:
                streams.remove(mine)
            following.cancel()

    @router.get("/events", **file_of(EVENTS, refused=()))
    async def get_events(request: Request) -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written. A comment comes at least every 5 s.

        The stream ends when the service stops, or when the token is no longer valid.
        """
        return StreamingResponse(lines(request), media_type=EVENTS)

    return router
