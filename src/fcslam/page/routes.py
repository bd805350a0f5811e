"""The files of the page. They hold no data of a mission, so nobody needs a token for them."""

import asyncio
from collections.abc import Awaitable, Callable
from hashlib import sha256

from fastapi import APIRouter, Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool

from fcslam.page import ASSETS, MODULES
from fcslam.page.report import report_html
from fcslam.service.http.app import PREFIX
from fcslam.service.http.authentication import Role
from fcslam.service.http.state import ViewerState

FILES = {
    "/": ("index.html", "text/html"),
    **{f"/{name}": (name, "text/javascript") for name in MODULES},
    "/page.css": ("page.css", "text/css"),
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


def page_router() -> APIRouter:
    """The page at ``/``, its script and its style."""
    router = APIRouter(include_in_schema=False)
    for path, (name, media_type) in FILES.items():
        router.add_api_route(path, _sender(name, media_type), methods=["GET"], response_class=Response)
    return router


def report_router(state: ViewerState) -> APIRouter:
    """The report of the open mission, for viewers."""
    router = APIRouter(include_in_schema=False, dependencies=state.require(Role.VIEWER, Role.ADMIN))

    turn = asyncio.Lock()  # a report takes much memory, and the threads are needed for packets

    @router.get(f"{PREFIX}/report.html")
    async def get_report() -> Response:
        """The page as one file."""
        async with turn:
            report = await run_in_threadpool(report_html, state.mission)
        headers = {"Content-Disposition": 'attachment; filename="report.html"', "X-Content-Type-Options": "nosniff"}
        return Response(report, media_type="text/html", headers=headers)

    return router


def _sender(name: str, media_type: str) -> Callable[[Request], Awaitable[Response]]:
    content = (ASSETS / name).read_bytes()
    headers = {**HEADERS, "ETag": f'"{sha256(content).hexdigest()}"'}

    async def send(request: Request) -> Response:
        if request.headers.get("if-none-match") == headers["ETag"]:
            return Response(status_code=304, headers=headers)
        return Response(content, media_type=media_type, headers=headers)

    return send
