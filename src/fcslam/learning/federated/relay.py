"""The routes of a service whose robots learn: requests of its robots go to the process in which the fleet learns."""

from pathlib import Path
from typing import Annotated

import httpx
from fastapi import APIRouter, HTTPException, Request, Response
from fastapi import Path as InPath

from fcslam.learning.federated.fleet_server import ANSWER_S, NUMBER_HEADER, PATH
from fcslam.service.authentication import Role
from fcslam.service.http.robots import Name
from fcslam.service.http.state import ServiceState

Operation = Annotated[str, InPath(pattern="^(next|reply/[0-9]{1,18})$")]
"""Nothing else may stand in the path: it would lead to the operations of another robot."""


def learning_router(state: ServiceState, listener: Path) -> APIRouter:
    """Routes for robots that learn, which have the tokens and limits of the service.

    ``listener`` is the Unix socket of the process in which the fleet learns; only the user of the service can open it.
    """
    router = APIRouter(include_in_schema=False)

    @router.post(f"{PATH}/{{operation:path}}", dependencies=state.require(Role.ROBOT))
    async def learn(request: Request, robot: Name, operation: Operation) -> Response:
        transport = httpx.AsyncHTTPTransport(uds=str(listener), verify=False)
        address = f"http://learning{PATH.format(robot=robot)}/{operation}"
        try:
            async with httpx.AsyncClient(transport=transport, timeout=ANSWER_S) as client:
                answer = await client.post(address, content=request.stream())
        except httpx.HTTPError as error:
            raise HTTPException(503, "the fleet does not learn now; try again", {"Retry-After": "5"}) from error
        headers = {name: answer.headers[name] for name in (NUMBER_HEADER, "content-type") if name in answer.headers}
        return Response(answer.content, answer.status_code, headers)

    return router
