"""Routes for robots."""

from typing import Annotated

from fastapi import APIRouter, Header, HTTPException, Path, Request
from fastapi.responses import FileResponse, Response
from starlette.concurrency import run_in_threadpool

from fcslam.records import NAME, Channel
from fcslam.service.authentication import Role
from fcslam.service.http.limits import read_body
from fcslam.service.http.responses import (
    DetectorSummary,
    PacketRefusal,
    RobotState,
    content,
    file_of,
    refusals,
)
from fcslam.service.http.state import ServiceState
from fcslam.wire.batches import (
    AGENT_HEADER,
    CORRECTION_HEADER,
    ENDED_HEADER,
    MEDIA_TYPE,
    REFUSED_HEADER,
    REMOVED_HEADER,
)
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES

NETWORK = "application/octet-stream"
"""Media type of a detector's file."""
_REFUSED = {
    REFUSED_HEADER: {
        "schema": {"type": "integer", "minimum": 0},
        "required": True,
        "description": "packets that count for nothing",
    },
    REMOVED_HEADER: {
        "schema": {"type": "integer", "minimum": 0, "maximum": 1},
        "required": True,
        "description": "whether an administrator removed the session",
    },
}
Name = Annotated[str, Path(pattern=f"^{NAME.pattern}$")]


def robot_router(state: ServiceState) -> APIRouter:
    """Packets in, acknowledgements and corrections out."""
    router = APIRouter(tags=["robots"], responses=refusals(400, 401, 403, 503))
    as_robot = state.require(Role.ROBOT)

    @router.post(
        "/robots/{robot}/packets",
        dependencies=as_robot,
        response_class=Response,
        responses={**refusals(400, 409, 413, 429, 507), 200: {**content(MEDIA_TYPE), "headers": _REFUSED}},
        openapi_extra={"requestBody": content(MEDIA_TYPE)},
    )
    async def send_packets(
        request: Request,
        robot: Name,
        agent: Annotated[str, Header(alias=AGENT_HEADER, max_length=64)] = "",
        correction: Annotated[int, Header(alias=CORRECTION_HEADER, ge=-1)] = -1,
        ended: Annotated[bool, Header(alias=ENDED_HEADER)] = False,
    ) -> Response:
        """Store a batch of packets; the response acknowledges what is on disk."""
        body = await read_body(request, MAXIMUM_BATCH_BYTES)

        def take() -> tuple[bytes, int, bool]:
            mission = state.mission
            taken = mission.intake.take(robot, agent, body, correction)
            if ended:
                mission.agents.end(robot)
            mission.worker.notify()
            return taken

        reply, refused, removed = await run_in_threadpool(take)
        state.measures.answer(robot, reply)
        headers = {REFUSED_HEADER: str(refused), REMOVED_HEADER: str(int(removed))}
        return Response(reply, media_type=MEDIA_TYPE, headers=headers)

    @router.get("/robots/{robot}/state", dependencies=as_robot, responses=refusals(507))
    def get_state(robot: Name) -> RobotState:
        """Where a robot continues after a restart, and which of its packets were refused."""
        mission = state.mission
        store, sessions = mission.store, mission.sessions(robot)
        newest = sessions[-1].epoch if sessions else None
        correction = None if newest is None else store.correction(robot, newest)
        return RobotState(
            robot=robot,
            epoch=newest,
            next={str(session.epoch): session.next for session in sessions},
            correction=correction.correction.version if correction else -1,
            map=correction.correction.map_index if correction else None,
            refusals=store.refused(robot).count,
            refused=[PacketRefusal(epoch=one[0], sequence=one[1], reason=one[2]) for one in store.refusals(robot)],
        )

    return router


def detector_router(state: ServiceState) -> APIRouter:
    """Detectors for robots."""
    router = APIRouter(responses=refusals(400, 401, 403, 503))

    @router.get("/detectors", tags=["fleet"], dependencies=state.require(Role.VIEWER, Role.ADMIN))
    def get_detectors() -> list[DetectorSummary]:
        """Detectors that robots may download, and whether they are announced."""
        announced = {(str(channel), file.version) for channel, file in state.missions.detectors.announced().items()}
        return [
            DetectorSummary(channel=Channel(channel), version=version, announced=(channel, version) in announced)
            for channel, version in state.missions.detectors.versions()
        ]

    @router.get(
        "/detectors/{channel}/{version}",
        tags=["robots"],
        dependencies=state.require(*Role),
        **file_of(NETWORK),
    )
    def get_detector(channel: Channel, version: Name) -> FileResponse:
        """The network of a detector version."""
        path = state.missions.detectors.path(channel, version)
        if not path.is_file():
            raise HTTPException(404, f"there is no {channel} detector '{version}'")
        return FileResponse(path, media_type=NETWORK)

    return router
