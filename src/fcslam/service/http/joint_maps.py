"""Routes for the fleet's map on every robot: tiles that changed, the poses of all robots, and where to explore."""

import gzip
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Header, HTTPException, Query, Request
from fastapi.responses import Response
from pydantic import BeforeValidator, Field
from starlette.concurrency import run_in_threadpool

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.config import StrictModel
from fcslam.errors import InputError
from fcslam.maps.joint_tiles import LARGEST_ANSWER
from fcslam.maps.occupancy_map import FARTHEST_M, map_stem
from fcslam.records import NAME
from fcslam.service.authentication import Role
from fcslam.service.http.limits import json_body, read_json
from fcslam.service.http.responses import file_of, refusals, unless_known
from fcslam.service.http.robots import NETWORK, Name
from fcslam.service.http.state import ServiceState
from fcslam.service.joint_maps import Exploration, JointMaps, ServedJointMaps
from fcslam.service.viewed_mission import viewed_run
from fcslam.untrusted import read_bytes
from fcslam.wire.fleet_replies import FleetReply, FrontierReply, MapFrontiers, QualityReply, TeammatePose

Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False, strict=True)]


def _number(value: object) -> object:
    """JSON knows 1.0 as an integer, and true as none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("is not a number")
    return value


class OwnPose(StrictModel):
    """Where a robot says it is."""

    map: Annotated[int, Field(ge=0), BeforeValidator(_number)] | None = Field(
        None, description="index of its map, as in its newest correction; null: not known"
    )
    pose: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="x and y in metres, theta in radians, in that map"
    )


def joint_map_router(state: ServiceState) -> APIRouter:
    """The joint map that a robot belongs to, and the other robots."""
    router = APIRouter(tags=["robots"], responses=refusals(400, 401, 403, 503))
    as_reader = state.require(*Role)

    def followed() -> tuple[ServedJointMaps, JointMaps]:
        mission = state.mission
        return mission.served_maps, mission.served_maps.follow(mission.joint_maps)

    @router.post(
        "/robots/{robot}/fleet",
        dependencies=state.require(Role.ROBOT),
        responses=refusals(413),
        openapi_extra=json_body(OwnPose),
    )
    async def exchange_poses(request: Request, robot: Name) -> FleetReply:
        """Send the pose of a robot, and get the poses of all robots."""
        return await run_in_threadpool(exchange, robot, await read_json(request, OwnPose))

    def exchange(robot: str, own: OwnPose) -> FleetReply:
        now_s = time.time()
        joint, maps = followed()
        if own.map is not None and own.pose is not None:
            joint.say(robot, own.map, own.pose, now_s)
        robots = []
        for session in maps.sessions:
            pose, said_s = joint.pose(session)
            robots.append(
                TeammatePose(
                    robot=session.robot,
                    map=session.map,
                    floor=session.floor,
                    pose=pose,
                    age_s=max(0.0, now_s - said_s),
                    stamp=session.stamp,
                )
            )
        return FleetReply(robots=tuple(robots))

    @router.get("/robots/{robot}/map", dependencies=as_reader, **file_of(NETWORK, is_tagged=True))
    def get_joint_map(
        robot: Name,
        limit: Annotated[int, Query(ge=1, le=LARGEST_ANSWER)] = LARGEST_ANSWER,
        known: Annotated[str, Header(alias="If-None-Match", max_length=64)] = "",
    ) -> Response:
        """The tiles of the map that a robot is in, changed since those whose ETag it sends; at most ``limit`` bytes."""
        joint, maps = followed()
        number = next((session.map for session in maps.sessions if session.robot == robot), None)
        frame, _, text = known.strip('"').partition("-")
        version = int(text) if text.isascii() and text.isdigit() else 0
        batch = None if number is None else joint.since(maps, number, frame, version, limit)
        if batch is None:
            raise HTTPException(404, f"robot '{robot}' is in no map yet")
        headers = {"ETag": f'"{batch.frame}-{batch.version}"', "Cache-Control": "private, no-cache"}
        if not batch.tiles and frame == batch.frame:
            return Response(status_code=304, headers=headers)
        body = batch.encode()
        state.measures.answer_map(robot, len(body))
        return Response(body, media_type=NETWORK, headers=headers)

    @router.get("/robots/{robot}/points", dependencies=as_reader, **file_of(NETWORK, is_tagged=True))
    def get_points(request: Request, robot: Name) -> Response:
        """The points of the map in space that a robot is in, as a PLY file that is as old as the live map."""
        folder = state.mission.run_folder
        if folder is None or not (numbers := _maps_of(folder, robot)):
            raise HTTPException(404, f"robot '{robot}' is in no map yet")
        file = folder / f"{map_stem(numbers.pop())}.ply"
        if not file.exists():
            raise HTTPException(404, f"the map of robot '{robot}' has no points in space yet")
        answer = unless_known(request, read_bytes(file, folder), NETWORK)
        if answer.status_code == 200 and "gzip" in request.headers.get("accept-encoding", ""):
            headers = {"ETag": answer.headers["etag"], "Content-Encoding": "gzip"}
            return Response(gzip.compress(answer.body, 6, mtime=0), media_type=NETWORK, headers=headers)
        return answer

    @router.get("/frontiers", dependencies=as_reader)
    def get_frontiers(robot: Annotated[str | None, Query(pattern=f"^{NAME.pattern}$")] = None) -> list[MapFrontiers]:
        """The frontiers of each map and the robot that has each; updated about every five seconds.

        With ``robot``, only the map that this robot is in, and only its distances.
        """
        joint, maps = followed()
        explored = joint.explorations(maps, time.time())
        of_robot = {one.map for one in maps.sessions if robot in (None, one.robot)}
        return [
            MapFrontiers(map=number, frontiers=tuple(_summaries(explored[number], robot)))
            for number in sorted(of_robot & explored.keys())
        ]

    @router.get("/quality", dependencies=as_reader)
    def get_quality(robot: Annotated[str | None, Query(pattern=f"^{NAME.pattern}$")] = None) -> list[QualityReply]:
        """Verdict and certificate of each map, up to half a minute old; with ``robot``, only of the map it is in."""
        folder = state.mission.run_folder
        return [] if folder is None else [one for one in _qualities(folder) if one.map_index in _maps_of(folder, robot)]

    return router


def _maps_of(folder: Path, robot: str | None) -> set[int]:
    """Numbers of the maps of the run in a folder: of all, or of the newest session of a robot."""
    sessions = viewed_run(folder).trajectories.values()
    if robot is None:
        return {session.map_index for session in sessions}
    own = {epoch: one.map_index for one in sessions for name, epoch in [robot_and_epoch(one.robot)] if name == robot}
    return {own[max(own)]} if own else set()


def _qualities(folder: Path) -> tuple[QualityReply, ...]:
    """The certificates of the run in a folder; none before there are some, and while it is replaced."""
    try:
        run = viewed_run(folder)
        certificates = json.loads(run.quality)
        return tuple(
            QualityReply.model_validate(
                {
                    **certificates[str(one.map_index)],
                    "map": one.map_index,
                    "verdict": str(one),
                    "drives": [concern.remedy for concern in one.concerns if concern.remedy],
                }
            )
            for one in run.verdict
            if str(one.map_index) in certificates
        )
    except (OSError, ValueError, LookupError, TypeError, AttributeError, InputError):
        return ()


def _summaries(explored: Exploration, robot: str | None) -> Iterator[FrontierReply]:
    robots, frontiers, goals = explored
    for one in frontiers:
        lengths = zip(robots, one.distances_m, strict=True)
        yield FrontierReply(
            point=(round(one.point[0], 3), round(one.point[1], 3)),
            length=round(one.length_m, 2),
            gain=round(one.gain_m2, 1),
            distances={
                name: round(length_m, 2)
                for name, length_m in lengths
                if robot in (None, name) and math.isfinite(length_m)
            },
            robots=tuple(sorted(name for name, goal in goals.items() if goal is one)),
        )
