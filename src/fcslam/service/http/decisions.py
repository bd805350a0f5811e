"""Decisions about the open mission: results, vetoes, detectors."""

import asyncio
from typing import Annotated

from fastapi import APIRouter, HTTPException, Request
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from fcslam.cloud.sessions import robot_of
from fcslam.config import Settings
from fcslam.records import NAME, Veto
from fcslam.service.detectors import LONGEST_FILE_BYTES
from fcslam.service.http.authentication import Role
from fcslam.service.http.limits import json_body, read_body, read_json
from fcslam.service.http.responses import DetectorVersion, Finalized, VetoCount, content, refusals
from fcslam.service.http.robots import NETWORK
from fcslam.service.http.state import ServiceState

LOOK_EVERY_S = 0.1

SessionName = Annotated[str, Field(pattern=f"^{NAME.pattern}$")]


class NewVeto(Settings):
    """A veto: two keyscans, or two robots, did not see the same place."""

    robot_i: SessionName
    robot_j: SessionName
    stamps: tuple[float, float] | None = Field(
        None,
        description="stamps of the two keyscans in seconds; without them, all closures of both robots",
    )


def decision_router(state: ServiceState) -> APIRouter:
    """Results and vetoes."""
    router = APIRouter(
        tags=["decisions"], dependencies=state.require(Role.ADMIN), responses=refusals(401, 403, 503, 507)
    )

    @router.post("/finalize", responses=refusals(500))
    async def finalize() -> Finalized:
        """Write the result of all packets that arrived as a run folder of the service; the response waits for it."""
        mission = state.mission
        number = await run_in_threadpool(mission.store.ask_to_finalize)
        mission.worker.ring()
        while not state.closing and mission is state.mission:
            asked = await run_in_threadpool(mission.store.finalization, number)
            if asked.failure:
                raise HTTPException(500, asked.failure)
            if asked.run:
                return Finalized(number=number, run=str(mission.folder.run(asked.run).resolve()))
            await asyncio.sleep(LOOK_EVERY_S)
        raise HTTPException(503, "the mission was closed; the result will be there when it is open again")

    @router.post("/vetoes", status_code=201, openapi_extra=json_body(NewVeto), responses=refusals(400, 404, 413))
    async def veto(request: Request) -> VetoCount:
        """Exclude closures from now on."""
        return await run_in_threadpool(_veto, state, await read_json(request, NewVeto))

    @router.post(
        "/detectors",
        status_code=201,
        openapi_extra={"requestBody": {"required": True, **content(NETWORK)}},
        responses=refusals(400, 413),
    )
    async def announce_detector(request: Request) -> DetectorVersion:
        """Add a network (ONNX) and announce it to every robot that has a camera and uses another one."""
        content = await read_body(request, LONGEST_FILE_BYTES)
        file = await run_in_threadpool(state.detectors.announce, content)
        return DetectorVersion(channel=file.channel, version=file.version)

    return router


def _veto(state: ServiceState, veto: NewVeto) -> VetoCount:
    mission = state.mission
    known = {robot.robot for robot in mission.intake.sessions()}
    unknown = [name for name in (veto.robot_i, veto.robot_j) if robot_of(name) not in known]
    if unknown:
        raise HTTPException(404, f"there is no robot '{unknown[0]}'; there are {', '.join(sorted(known))}")
    mission.store.veto(Veto(veto.robot_i, veto.robot_j, veto.stamps))
    mission.worker.ring()
    return VetoCount(vetoes=len(mission.store.vetoes()))
