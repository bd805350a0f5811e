"""Routes for viewers: the live run as numbers and as files, and events as they happen (server-sent events)."""

import asyncio
import hashlib
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse, Response, StreamingResponse
from pydantic import Field, TypeAdapter
from starlette.concurrency import run_in_threadpool

from fcslam.errors import InputError
from fcslam.maps.exports import export_map
from fcslam.maps.occupancy_map import map_stem
from fcslam.maps.tiles import DEEPEST_ZOOM, tile_png
from fcslam.records import Channel, ClosureStatus
from fcslam.runs import CONFIG, METRICS, POSE_GRAPH, QUALITY, TRAJECTORIES, ClosureRow, Run
from fcslam.service.http.authentication import Role
from fcslam.service.http.responses import (
    ClosureSummary,
    EditSummary,
    FleetSummary,
    LearningRound,
    MapJoin,
    MapLayer,
    MapSeparation,
    MapShape,
    MapSummary,
    RobotSummary,
    SessionSummary,
    WallDirection,
    file_of,
    refusals,
)
from fcslam.service.http.robots import Name, refused_packets
from fcslam.service.http.state import ViewerState
from fcslam.service.keyscans import live_scan, overlay_png
from fcslam.service.map_layers import map_shapes, walls_of
from fcslam.service.summaries import (
    all_edits,
    all_sessions,
    closure_summary,
    fleet_summary,
    map_joins,
    map_separations,
    map_summaries,
    newest_closures,
    read_rounds,
    run_of,
    sessions_of,
    trajectories_zip,
)
from fcslam.untrusted import check_file, read_bytes
from fcslam.wire.limits import MAXIMUM_EPOCH

EVENTS = "text/event-stream"
VIEWERS = Role.VIEWER, Role.ADMIN
BEAT_S = 5.0
"""Something comes at least so often, so that a client notices a dead connection."""
MOST_STREAMS = 200
"""Streams at a time: each costs the process a look four times a second. A further one ends the oldest, whose client
asks again if it is still there."""
LOOK_S = 0.25
"""How often a stream asks whether it may go on."""
MOST = 2**31 - 1
"""Largest number of a map or tile."""
Index = Annotated[int, PathParameter(ge=0, le=MOST)]
Square = Annotated[int, PathParameter(ge=-MOST, le=MOST)]
Point = Annotated[list[float], Field(min_length=2, max_length=2, description="x and y in metres")]
Stamp = Annotated[float, PathParameter(allow_inf_nan=False, description="of a keyscan, seconds")]
KEPT = {"Cache-Control": "private, max-age=60"}
"""Headers of answers that are computed for a request and hardly change."""
TEXT, JSON = "text/plain", "application/json"
MEDIA = {
    "png": "image/png",
    "pgm": "image/x-portable-graymap",
    "yaml": "application/yaml",
    "svg": "image/svg+xml",
    "tif": "image/tiff",
    "zip": "application/zip",
}

_ROWS = {"type": "array", "items": {"type": "object", "required": ["name", "value", "unit"]}}
_SETTINGS = {"type": "object"}
_SHAPES = TypeAdapter(list[MapShape])


def fleet_router(state: ViewerState) -> APIRouter:
    """Robots, closures, edits and learning."""
    router = APIRouter(tags=["fleet"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503, 507))

    @router.get("/fleet")
    def get_fleet(request: Request) -> FleetSummary:
        """Counts."""
        may_edit = not state.read_only and state.admits(request, Role.ADMIN)
        return fleet_summary(state.mission, state.read_only, may_edit)

    @router.get("/robots")
    def get_robots() -> list[SessionSummary]:
        """All robots' sessions."""
        return all_sessions(state.mission)

    @router.get("/robots/{robot}", responses=refusals(400, 404))
    def get_robot(robot: Name) -> RobotSummary:
        """One robot's sessions, and packets of it that were refused."""
        sessions = sessions_of(state.mission, robot)
        if not sessions:
            raise HTTPException(404, f"there is no robot '{robot}'")
        return RobotSummary(robot=robot, sessions=sessions, refused=refused_packets(state.mission.store, robot))

    @router.get("/closures", response_model=list[ClosureSummary], responses=refusals(400))
    def get_closures(
        request: Request, status: ClosureStatus | None = None, limit: Annotated[int, Query(ge=1, le=10_000)] = 1000
    ) -> Response:
        """The newest closures."""
        return _if_changed(request, newest_closures(run_of(state.mission), status, limit), JSON)

    @router.get(
        "/closures/{channel}/{robot_i}/{stamp_i}/{robot_j}/{stamp_j}.png",
        **file_of(MEDIA["png"], refused=(400, 404)),
    )
    def get_closure_picture(channel: Channel, robot_i: Name, stamp_i: Stamp, robot_j: Name, stamp_j: Stamp) -> Response:
        """Walls around both ends of a closure, laid on each other as it measured them."""
        run = run_of(state.mission)
        closure = _closure_of(run, channel, robot_i, stamp_i, robot_j, stamp_j)
        with _or_404():
            picture = overlay_png(state.mission.store, run, closure)
        return Response(picture, media_type=MEDIA["png"], headers=KEPT)

    @router.get("/closures/{channel}/{robot_i}/{stamp_i}/{robot_j}/{stamp_j}", responses=refusals(400, 404))
    def get_closure(channel: Channel, robot_i: Name, stamp_i: Stamp, robot_j: Name, stamp_j: Stamp) -> ClosureSummary:
        """One closure as it is now."""
        return closure_summary(_closure_of(run_of(state.mission), channel, robot_i, stamp_i, robot_j, stamp_j))

    @router.get("/joins")
    def get_joins() -> list[MapJoin]:
        """On what evidence robots share a map, for every two with closures between them that agree."""
        return map_joins(state.mission)

    @router.get("/robots/{robot}/scans/{epoch}", responses=refusals(400, 404))
    def get_scan(robot: Name, epoch: Annotated[int, PathParameter(ge=0, le=MAXIMUM_EPOCH)]) -> list[Point]:
        """Points of the newest scan of a session in the robot's base frame, metres; empty before the first scan."""
        points: list[Point] = live_scan(state.mission.store, robot, epoch).round(3).tolist()
        return points

    @router.get("/edits")
    def get_edits() -> list[EditSummary]:
        """All edits, and what undid them."""
        return all_edits(state.mission)

    @router.get("/learning")
    def get_learning() -> list[LearningRound]:
        """The rounds of the federated training, oldest first; none if the service knows of no training."""
        return [] if state.learning is None else read_rounds(state.learning)

    return router


def map_router(state: ViewerState) -> APIRouter:
    """The run's files."""
    router = APIRouter(tags=["maps"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    @router.get("/maps")
    def get_maps() -> list[MapSummary]:
        """The robots of each map."""
        return map_summaries(state.mission)

    @router.get("/separations")
    def get_separations() -> list[MapSeparation]:
        """Why maps of one floor are separate, for every two of them."""
        return map_separations(state.mission)

    @router.get("/maps/{k}.{suffix}", **file_of(*MEDIA.values(), refused=(400, 404)))
    def get_map(k: Index, suffix: Annotated[str, PathParameter(pattern="^(png|pgm|yaml|svg|tif|zip)$")]) -> Response:
        """A map: picture, occupancy, what map_server needs to know of it, both in one archive, drawing, and GeoTIFF if
        its place on earth is known.
        """
        if suffix not in ("svg", "tif", "zip"):
            return _file(state, f"{map_stem(k)}.{suffix}", MEDIA[suffix])
        exported = export_map(_folder_of(state), k, suffix)
        if exported is None:
            raise HTTPException(404, f"there is no {map_stem(k)}, or its place on earth is not known")
        return Response(exported, media_type=MEDIA[suffix])

    @router.get("/maps/{k}/tiles/{z}/{x}/{y}.png", **file_of(MEDIA["png"], refused=(400, 404), is_tagged=True))
    def get_tile(
        request: Request, k: Index, z: Annotated[int, PathParameter(ge=0, le=DEEPEST_ZOOM)], x: Square, y: Square
    ) -> Response:
        """A square of a map: at zoom z it has 512 m / 2^z; x and y count squares from the origin, y upwards."""
        try:
            tile = tile_png(_folder_of(state), map_stem(k), z, x, y)
        except FileNotFoundError as error:
            raise HTTPException(404, f"there is no {map_stem(k)}") from error
        return _if_changed(request, tile, MEDIA["png"])

    turn = asyncio.Lock()  # one at a time: changes take all packets and several maps, an archive all its files

    @router.get(
        "/maps/{k}/layers/{layer}",
        response_model=list[MapShape],
        responses={**refusals(400), 304: {"description": "as you have it"}},
    )
    async def get_layer(request: Request, k: Index, layer: MapLayer) -> Response:
        """What is drawn over a map: floor plan and deviations, changes since the first day, tags, certificate."""
        async with turn:
            shapes = await run_in_threadpool(map_shapes, state.mission, k, layer)
            return _if_changed(request, _SHAPES.dump_json(shapes), JSON)

    @router.get("/maps/{k}/walls", responses=refusals(400, 404))
    async def get_walls(k: Index) -> WallDirection:
        """The direction of most walls of a map."""
        image = _existing(state, f"{map_stem(k)}.pgm")
        with _or_404():
            async with turn:
                return await run_in_threadpool(walls_of, image.parent, k)

    @router.get(f"/{METRICS}", **file_of(JSON, model=_ROWS))
    def get_metrics() -> FileResponse:
        """All metrics with their units."""
        return _file(state, METRICS, JSON)

    @router.get("/quality.json", **file_of(JSON, model=_SETTINGS))
    def get_quality() -> FileResponse:
        """The certificate of each map, by its number; of a live map about half a minute old."""
        return _file(state, f"{QUALITY}.json", JSON)

    @router.get(f"/{CONFIG}", **file_of(MEDIA["yaml"], model=_SETTINGS))
    def get_config() -> FileResponse:
        """The complete configuration."""
        return _file(state, CONFIG, MEDIA["yaml"])

    @router.get("/pose_graph.g2o", **file_of(TEXT))
    def get_pose_graph() -> FileResponse:
        """The pose graph."""
        return _file(state, POSE_GRAPH, TEXT)

    @router.get(f"/{TRAJECTORIES}.zip", **file_of(MEDIA["zip"]))
    async def get_trajectories() -> Response:
        """The poses of all sessions, a file each."""
        folder = _folder_of(state)
        with _or_404():
            async with turn:
                archive = await run_in_threadpool(trajectories_zip, folder)
        if archive is None:
            raise HTTPException(404, "there are no trajectories")
        return Response(archive, media_type=MEDIA["zip"])

    @router.get("/trajectories/{session}.tum", **file_of(TEXT, refused=(400, 404)))
    def get_trajectory(
        session: Name,
        after: Annotated[int, Query(ge=0, le=MOST)] = 0,
        digest: Annotated[str, Query(pattern="^[0-9a-f]{64}$|^$")] = "",
    ) -> Response:
        """Poses of a session's keyscans in its map.

        A client that has the first ``after`` bytes sends the digest that came with them. It gets only the rest if those
        bytes have not changed. ``Fcslam-After`` is the number of omitted bytes; ``Fcslam-Digest`` is the digest of all
        up to now.
        """
        path = _existing(state, f"{TRAJECTORIES}/{session}.tum")
        poses = read_bytes(path)
        known = after if after <= len(poses) and digest == hashlib.sha256(poses[:after]).hexdigest() else 0
        headers = {"Fcslam-After": str(known), "Fcslam-Digest": hashlib.sha256(poses).hexdigest()}
        return Response(poses[known:], media_type=TEXT, headers=headers)

    return router


def event_router(state: ViewerState) -> APIRouter:
    """One stream."""
    router = APIRouter(tags=["viewers"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    streams: list[object] = []

    async def lines(request: Request) -> AsyncIterator[str]:
        mine = object()
        streams.append(mine)
        del streams[:-MOST_STREAMS]
        loop, events = asyncio.get_running_loop(), state.events.watch()
        said_s, following = loop.time(), asyncio.ensure_future(anext(events))
        try:
            while mine in streams and state.admits(request, *VIEWERS):
                await asyncio.wait({following}, timeout=LOOK_S)
                if following.done():
                    event = following.result()
                    said_s, following = loop.time(), asyncio.ensure_future(anext(events))
                    yield f"event: {event.kind}\ndata: {json.dumps({'number': event.number})}\n\n"
                elif loop.time() - said_s >= BEAT_S:
                    said_s = loop.time()
                    yield ": nothing new\n\n"
        finally:
            if mine in streams:
                streams.remove(mine)
            following.cancel()

    @router.get("/events", **file_of(EVENTS, refused=()))
    async def get_events(request: Request) -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written. A comment comes at least every 5 s.

        The stream ends when the service stops, or when the token is no longer valid.
        """
        return StreamingResponse(lines(request), media_type=EVENTS)

    return router


def _if_changed(request: Request, body: bytes, media_type: str) -> Response:
    """An answer whose body is left out if the client says that it has it (RFC 9110, 13.1.2)."""
    tag = f'"{hashlib.sha256(body).hexdigest()}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type=media_type, headers=headers)


@contextmanager
def _or_404() -> Iterator[None]:
    """Refuse (HTTPException 404) what cannot be read of a run."""
    try:
        yield
    except InputError as error:
        raise HTTPException(404, str(error)) from error


def _closure_of(run: Run, *named: Channel | str | float) -> ClosureRow:
    """The closure with this channel, robot and stamp of i, robot and stamp of j."""
    for c in run.closures:
        if named == (c.channel, c.robot_i, c.stamp_i, c.robot_j, c.stamp_j):
            return c
    raise HTTPException(404, "this closure does not exist at present")


def _folder_of(state: ViewerState) -> Path:
    folder = state.mission.run_folder
    if folder is None:
        raise HTTPException(404, "there is no map yet")
    return folder


def _file(state: ViewerState, name: str, media_type: str) -> FileResponse:
    return FileResponse(_existing(state, name), media_type=media_type)


def _existing(state: ViewerState, name: str) -> Path:
    folder = _folder_of(state)
    try:
        check_file(folder / name, folder)
    except OSError as error:
        raise HTTPException(404, f"there is no {name} that can be read ({error.strerror or error})") from error
    return folder / name
