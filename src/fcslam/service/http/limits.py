"""Rate and size limits of requests."""

from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import HTTPException, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from fcslam.service.http.responses import content
from fcslam.service.intake import TokenBuckets
from fcslam.wire.batches import LENGTH, read_batch
from fcslam.wire.packets import unpacked_size

BYTES_PER_S = 8.0 * 2**20
"""Bytes per second of one robot: a thousand times its rate while it drives, for the backlog after an outage."""
BURST_BYTES = 32.0 * 2**20
REQUEST_BYTES = 16.0 * 2**10
"""Cost of a request besides its bytes, in bytes."""
LONGEST_JSON_BYTES = 64 * 2**10

CONTENT = "content"
"""Key of the body in the state of a request, for the audit log."""

_Model = TypeVar("_Model", bound=BaseModel)


class RateLimit:
    """Bytes of each robot's requests. Any thread may call."""

    def __init__(self, clock: Callable[[], float], burst: float = BURST_BYTES) -> None:
        self._largest = int(burst - REQUEST_BYTES)
        self._buckets = TokenBuckets(clock, BYTES_PER_S, burst)

    def check(self, robot: str, batch: bytes = b"") -> None:
        """Count a request. Refuses more than the robot may send: 413, 429 (HTTPException)."""
        size = sum(LENGTH.size + unpacked_size(packet) for packet in read_batch(batch))  # unpacking takes time
        if size > self._largest:
            raise HTTPException(413, f"the batch unpacks to {size} bytes; send fewer packets at once")
        wait_s = self._buckets.wait_s(robot, REQUEST_BYTES + size)
        if wait_s > 0.0:
            raise HTTPException(429, "too much at once; wait", {"Retry-After": str(int(wait_s) + 1)})


async def read_body(request: Request, longest: int) -> bytes:
    """A request's body, refused (HTTPException 413) before more than ``longest`` bytes of it are read."""
    announced = request.headers.get("content-length", "0")
    too_long = HTTPException(413, f"the body is over {longest} bytes; send less at once")
    if announced.isdecimal() and int(announced) > longest:
        raise too_long
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > longest:
            raise too_long
    return bytes(body)


async def read_json(request: Request, model: type[_Model]) -> _Model:
    """A request's body as ``model``. For handlers: FastAPI itself would read it all before it asks who sends it.

    Refuses: 413 (HTTPException) over 64 KiB, 400 (RequestValidationError) what is no such thing.
    """
    body = await read_body(request, LONGEST_JSON_BYTES)
    try:
        read = model.model_validate_json(body)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        raise RequestValidationError([{**one, "loc": ("body", *one["loc"])} for one in found]) from error
    setattr(request.state, CONTENT, read.model_dump())
    return read


def json_body(model: type[BaseModel]) -> dict[str, Any]:
    """The OpenAPI description of a body that ``read_json`` reads."""
    return {"requestBody": {"required": True, **content("application/json", model=model.model_json_schema())}}
