"""Every refusal is one line of JSON: {"error": what, where, what to do}."""

import math
from collections.abc import Mapping

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.routing import Match

from fcslam.errors import (
    FcslamError,
    FeatureError,
    InputError,
    PacketConflictError,
    PacketError,
    StoreError,
    UnavailableError,
)
from fcslam.service.intake import PlaneError
from fcslam.service.missions import UnknownMissionError

STATUS: dict[type[FcslamError], int] = {
    UnavailableError: 429,
    PacketConflictError: 409,
    PacketError: 400,
    PlaneError: 403,
    StoreError: 507,
    UnknownMissionError: 404,
    InputError: 409,
    FeatureError: 400,
}
"""HTTP status by exception class; the most derived class counts."""


def problem(status: int, error: str, headers: Mapping[str, str] | None = None, **more: object) -> JSONResponse:
    """The response to a refused request."""
    return JSONResponse({"error": " ".join(error.split()), **more}, status, headers)


def add_handlers(app: FastAPI) -> None:
    """Turn exceptions into responses."""
    app.add_exception_handler(FcslamError, _on_fcslam_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(ClientDisconnect, _on_disconnect)
    app.add_exception_handler(Exception, _on_anything_else)


def _on_fcslam_error(_: Request, error: Exception) -> JSONResponse:
    is_away = isinstance(error, StoreError) and error.is_away
    status = 503 if is_away else next((STATUS[kind] for kind in type(error).mro() if kind in STATUS), 500)
    headers = {"Retry-After": str(math.ceil(error.retry_after_s))} if isinstance(error, UnavailableError) else None
    index = getattr(error, "index", None)
    return problem(status, str(error), headers, **({} if index is None else {"index": index}))


def _on_http_exception(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    headers = {"Allow": _allowed(request)} if error.status_code == 405 else error.headers
    return problem(error.status_code, str(error.detail), headers)


def _allowed(request: Request) -> str:
    """Methods of all routes with this path: Starlette looks at the first one only."""
    routes = [
        route
        for route in iter_route_contexts(request.app.routes)
        if route.matches(dict(request.scope))[0] is not Match.NONE
    ]
    return ", ".join(sorted({method for route in routes for method in route.methods or ()}))


def _on_validation_error(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return problem(400, f"{where}: {first['msg']}")


def _on_disconnect(_: Request, _error: Exception) -> JSONResponse:
    """The client left within its request: no fault of the service, and nobody reads the response."""
    return problem(400, "the body ends before its end")


def _on_anything_else(_: Request, error: Exception) -> JSONResponse:
    """A fault of the service: the log holds the details, the response does not."""
    return problem(500, f"the service failed on it ({type(error).__name__}); its log says more")
