"""The stream of events for viewers (server-sent events)."""

import asyncio
import json
import time
from collections.abc import AsyncIterator

from fastapi import APIRouter, Request
from fastapi.responses import StreamingResponse

from fcslam.service.http.authentication import VIEWERS
from fcslam.service.http.responses import file_of, refusals
from fcslam.service.http.state import ViewerState

EVENTS = "text/event-stream"
MOST_STREAMS = 200
"""Streams at a time: each costs the process a look four times a second. A further one ends the oldest, whose client
asks again if it is still there."""
LOOK_S = 0.25
"""How often something that waits looks again: a stream for events, a request for its result."""


def event_router(state: ViewerState) -> APIRouter:
    """One stream."""
    router = APIRouter(tags=["viewers"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    streams: list[object] = []

    async def lines(request: Request) -> AsyncIterator[str]:
        mine, said, said_s = object(), dict[str, tuple[int, int]](), time.monotonic()
        streams.append(mine)
        del streams[:-MOST_STREAMS]
        try:
            while mine in streams and state.admits(request, *VIEWERS):
                newest = state.events.newest()
                news = [(kind, number) for kind, (_, number) in newest.items() if said.get(kind) != newest[kind]]
                if news or time.monotonic() - said_s >= state.events.beat_s:
                    said, said_s = newest, time.monotonic()
                    told = [f"event: {kind}\ndata: {json.dumps({'number': number})}\n\n" for kind, number in news]
                    yield "".join(told) or ": nothing new\n\n"
                await asyncio.sleep(LOOK_S)
        finally:
            if mine in streams:
                streams.remove(mine)

    @router.get("/events", **file_of(EVENTS, refused=()))
    async def get_events(request: Request) -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written. A comment comes at least every 5 s.

        The stream ends when the service stops, or when the token is no longer valid.
        """
        return StreamingResponse(lines(request), media_type=EVENTS)

    return router
