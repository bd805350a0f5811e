"""Routes of missions: create, open, export, import, results."""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse
from pydantic import Field
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool

from fcslam.config import StrictModel
from fcslam.errors import StoreError
from fcslam.mission.mission_store import check_mission
from fcslam.records import NAME
from fcslam.service.authentication import Role
from fcslam.service.http.limits import json_body, read_json
from fcslam.service.http.responses import MissionList, content, file_of, refusals
from fcslam.service.http.robots import Name
from fcslam.service.http.state import ServiceState
from fcslam.service.missions import EXPORT, IMPORT
from fcslam.storage.database import translate_errors

FILE = "application/vnd.sqlite3"
"""Media type of an exported mission."""
ZIP = "application/zip"
LONGEST_IMPORT_BYTES = 64 * 2**30

RunNumber = Annotated[int, PathParameter(ge=1, le=2**31 - 1, description="that `POST /finalize` returned")]
MissionName = Annotated[str, Field(pattern=f"^{NAME.pattern}$")]


class NewMission(StrictModel):
    """A mission to create."""

    name: MissionName


def mission_router(state: ServiceState) -> APIRouter:
    """All missions of the service, which one is open, and missions and results as files."""
    router = APIRouter(tags=["missions"], responses=refusals(401, 403, 503))
    as_admin = state.require(Role.ADMIN)

    @router.get("/missions", dependencies=state.require(Role.VIEWER, Role.ADMIN))
    def list_missions() -> MissionList:
        """All missions, and which one is open."""
        return MissionList(open=state.mission.folder.name, missions=state.missions.names)

    def change(work: Callable[..., None], *arguments: object) -> MissionList:
        with state.changing:
            work(*arguments)
        return list_missions()

    @router.post(
        "/missions",
        status_code=201,
        dependencies=as_admin,
        openapi_extra=json_body(NewMission),
        responses=refusals(400, 409, 413, 507),
    )
    async def create_mission(request: Request) -> MissionList:
        """Create a mission and open it."""
        mission = await read_json(request, NewMission)
        return await run_in_threadpool(change, state.missions.create, mission.name)

    @router.post("/missions/{name}/open", dependencies=as_admin, responses=refusals(400, 404, 507))
    def open_mission(name: Name) -> MissionList:
        """Open a mission; robots' packets go to it from now on."""
        return change(state.missions.open, name)

    @router.post(
        "/missions/import",
        status_code=201,
        dependencies=as_admin,
        openapi_extra={"requestBody": {"required": True, **content(FILE)}},
        responses=refusals(400, 409, 413, 507),
    )
    async def import_mission(request: Request, name: Annotated[MissionName, Query()]) -> MissionList:
        """Import an exported mission; the open one stays open."""
        with tempfile.TemporaryDirectory(dir=state.missions.root, prefix=IMPORT) as folder:
            path = Path(folder) / "mission.sqlite"
            await _receive(request, path)
            try:
                await run_in_threadpool(check_mission, path)
            except StoreError as error:
                raise HTTPException(400, f"the body is not an exported mission ({error})") from error
            return await run_in_threadpool(change, state.missions.import_mission, name, path)

    @router.get("/missions/{name}/export", dependencies=as_admin, **file_of(FILE, refused=(400, 404, 507)))
    def export_mission(name: Name) -> FileResponse:
        """A mission as one file."""
        return _download(state, f"{name}.sqlite", FILE, lambda path: state.missions.export(name, path))

    @router.get("/missions/{name}/runs/{number}.zip", dependencies=as_admin, **file_of(ZIP, refused=(400, 404, 507)))
    def download_run(name: Name, number: RunNumber) -> FileResponse:
        """A result as one file: the run folder in a ZIP archive."""
        run = state.missions.result(name, number) if name in state.missions.names else None
        if run is None:
            raise HTTPException(404, f"mission '{name}' has no result {number}; POST /finalize makes one")
        return _download(state, f"{name}-{number}.zip", ZIP, lambda path: _pack(run, path))

    return router


def _pack(folder: Path, archive: Path) -> None:
    """Write a ZIP archive of a folder's files; ``archive`` ends in ``.zip``."""
    with translate_errors(archive):
        shutil.make_archive(str(archive.with_suffix("")), "zip", folder)


def _download(state: ServiceState, name: str, media_type: str, write: Callable[[Path], None]) -> FileResponse:
    """Send a file that ``write`` makes in a folder of its own, which is removed afterwards."""
    folder = tempfile.TemporaryDirectory(dir=state.missions.root, prefix=EXPORT)
    path = Path(folder.name) / name
    try:
        write(path)
    except BaseException:
        folder.cleanup()
        raise
    return FileResponse(path, media_type=media_type, filename=name, background=BackgroundTask(folder.cleanup))


async def _receive(request: Request, path: Path) -> None:
    size = 0
    with path.open("wb") as file:
        async for chunk in request.stream():
            size += len(chunk)
            if size > LONGEST_IMPORT_BYTES:
                raise HTTPException(413, f"the file is over {LONGEST_IMPORT_BYTES} bytes")
            with translate_errors(path):
                await run_in_threadpool(file.write, chunk)
