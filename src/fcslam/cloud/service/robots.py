"""What robots ask."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, HTTPException, Path, Request
from fastapi.responses import FileResponse, Response
from starlette.concurrency import run_in_threadpool

from fcslam.cloud.intake import Answer
from fcslam.cloud.service.authentication import Role
from fcslam.cloud.service.limits import RateLimit, read_body
from fcslam.cloud.service.state import ServiceState
from fcslam.records import NAME, Channel
from fcslam.wire.batches import AGENT_HEADER, CORRECTION_HEADER, LENGTH, MEDIA_TYPE, read_batch
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES
from fcslam.wire.packets import unpacked_size

Name = Annotated[str, Path(pattern=f"^{NAME.pattern}$")]


def robot_router(state: ServiceState) -> APIRouter:
    """Packets in, acknowledgements and corrections out; detectors."""
    router = APIRouter(tags=["robots"])
    as_robot = Depends(state.require(Role.ROBOT))
    content = {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}

    @router.post(
        "/robots/{robot}/packets",
        dependencies=[as_robot],
        response_class=Response,
        responses={200: {"content": content}},
        openapi_extra={"requestBody": {"content": content}},
    )
    async def send_packets(
        request: Request,
        robot: Name,
        agent: Annotated[str, Header(alias=AGENT_HEADER, max_length=64)] = "",
        correction: Annotated[int, Header(alias=CORRECTION_HEADER, ge=-1)] = -1,
    ) -> Response:
        """Store a batch of packets; the answer acknowledges what is on disk."""
        body = await read_body(request, MAXIMUM_BATCH_BYTES)
        mission = state.mission

        def take() -> Answer:
            _check_rate(state.rate, robot, body)
            return mission.intake.take(robot, agent, body, correction)

        answer = await run_in_threadpool(take)
        mission.worker.ring()
        state.measures.count(answer.packets, answer.batch, robot)
        return Response(answer.batch, media_type=MEDIA_TYPE)

    @router.get("/robots/{robot}/state", dependencies=[as_robot])
    def get_state(robot: Name) -> dict[str, object]:
        """Where a robot that starts again goes on: by epoch, the number of the first packet that is missing."""
        store = state.mission.store
        sessions = store.sessions(robot)
        newest = sessions[-1].epoch if sessions else None
        correction = None if newest is None else store.correction(robot, newest)
        return {
            "robot": robot,
            "epoch": newest,
            "next": {str(session.epoch): session.next for session in sessions},
            "correction": correction.correction.version if correction else -1,
            "map": correction.correction.map_index if correction else None,
        }

    @router.get("/detectors/{channel}/{version}", dependencies=[Depends(state.require(*Role))])
    def get_detector(channel: Channel, version: Name) -> FileResponse:
        """The network of a detector version."""
        path = state.detectors.path(channel, version)
        if not path.is_file():
            raise HTTPException(404, f"there is no {channel} detector '{version}'")
        return FileResponse(path, media_type="application/octet-stream")

    return router


def _check_rate(rate: RateLimit, robot: str, body: bytes) -> None:
    """Refuse (HTTPException 413, 429) more than the robot may send."""
    size = _unpacked_size(body)
    if size > rate.largest:
        raise HTTPException(413, f"the batch unpacks to {size} bytes; send fewer packets at once")
    wait_s = rate.wait_s(robot, size)
    if wait_s > 0.0:
        raise HTTPException(429, "too much at once; wait", {"Retry-After": str(int(wait_s) + 1)})


def _unpacked_size(body: bytes) -> int:
    """What a batch counts in its robot's rate: it takes time to unpack, however short it travels.

    Raises:
        PacketError: it is no batch.
    """
    return sum(LENGTH.size + unpacked_size(packet) for packet in read_batch(body))
