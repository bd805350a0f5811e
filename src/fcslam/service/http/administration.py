"""Routes of administrators about the open mission: results, edits, detectors."""

import asyncio
import json
import shutil
from typing import Annotated, Any, Literal

from fastapi import APIRouter, HTTPException, Path, Request
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from fcslam.config import StrictModel
from fcslam.errors import InputError, StoreError
from fcslam.mission.edits import read_edit
from fcslam.records import MOST_NETWORK_BYTES, Change, Undo
from fcslam.service.authentication import Role
from fcslam.service.http.fleet import LOOK_S, edit_summary
from fcslam.service.http.limits import json_body, read_body, read_json
from fcslam.service.http.responses import DetectorSummary, EditSummary, Finalized, content, refusals
from fcslam.service.http.robots import NETWORK
from fcslam.service.http.state import ServiceState

LEAST_FREE_BYTES = 8 * 2**20
"""A disk with less is full: neither a result nor the reason for a failure can be written reliably."""

EditNumber = Annotated[int, Path(ge=1, le=2**31 - 1)]


class NewEdit(StrictModel):
    """An edit: what changes about the mission from now on."""

    kind: Literal["veto", "removal", "cut", "pin", "closure", "placement", "region", "floor"]
    content: dict[str, Any] = Field(
        description="what it names, as `GET /edits` shows it; examples: docs/howto/operate.md"
    )


def administration_router(state: ServiceState) -> APIRouter:
    """Results, edits and detectors."""
    router = APIRouter(
        tags=["decisions"], dependencies=state.require(Role.ADMIN), responses=refusals(401, 403, 503, 507)
    )

    @router.post("/finalize", responses=refusals(404, 500))
    async def finalize() -> Finalized:
        """Write the result of all packets that arrived as a run folder of the service; the response waits for it."""
        mission = await run_in_threadpool(lambda: state.mission)
        number = await run_in_threadpool(mission.ask_to_finalize)
        while not state.closing and mission is await run_in_threadpool(lambda: state.mission):
            asked = await run_in_threadpool(mission.store.finalization, number)
            if asked.failure:
                raise HTTPException(500, asked.failure)
            if asked.run:
                run = await run_in_threadpool(mission.result, asked.run)
                if run is None:
                    raise HTTPException(404, f"result {number} was removed, because there are several newer ones")
                return Finalized(
                    number=number, run=str(run), archive=f"/api/v1/missions/{mission.folder.name}/runs/{number}.zip"
                )
            free = shutil.disk_usage(mission.folder.path).free
            if free < LEAST_FREE_BYTES:
                raise HTTPException(
                    507,
                    f"{free} bytes are free on the disk; free some, and the worker writes result {number} by itself",
                )
            await asyncio.sleep(LOOK_S)
        raise HTTPException(503, "the mission was closed; the result will be there when it is open again")

    @router.post("/edits", status_code=201, openapi_extra=json_body(NewEdit), responses=refusals(400, 404, 409, 413))
    async def edit(request: Request) -> EditSummary:
        """Append an edit. It counts from now on, and can be undone; packets stay stored all the same."""
        new = await read_json(request, NewEdit)
        content = read_edit(new.kind, json.dumps(new.content))
        return await run_in_threadpool(_edit, state, request.state.actor, content)

    @router.post("/edits/{number}/undo", status_code=201, responses=refusals(400, 404, 409))
    async def undo(request: Request, number: EditNumber) -> EditSummary:
        """Undo an edit. Removals and floors are undone when the worker has applied all packets again."""
        return await run_in_threadpool(_edit, state, request.state.actor, Undo(number))

    @router.post(
        "/detectors",
        status_code=201,
        openapi_extra={"requestBody": {"required": True, **content(NETWORK)}},
        responses=refusals(400, 413),
    )
    async def announce_detector(request: Request) -> DetectorSummary:
        """Add a network (ONNX) and announce it to every robot that has a camera and uses another one."""
        content = await read_body(request, MOST_NETWORK_BYTES)
        file = await run_in_threadpool(state.missions.detectors.announce, content)
        return DetectorSummary(channel=file.channel, version=file.version, announced=True)

    return router


def _edit(state: ServiceState, author: str, content: Change | Undo) -> EditSummary:
    mission = state.mission
    try:
        mission.store.check_named(content)
    except StoreError:
        raise
    except InputError as error:
        raise HTTPException(404, str(error)) from error
    return edit_summary(mission.edit(content, author))
