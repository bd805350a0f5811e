"""Routes of viewers about maps: what each map is, its pictures and shapes, and the files of the run."""

import asyncio
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse, Response
from pydantic import TypeAdapter
from starlette.concurrency import run_in_threadpool

from fcslam.errors import InputError
from fcslam.maps.exports import earth_frame, export_map, zipped
from fcslam.maps.occupancy_map import HEADER_BYTES, area_of, map_stem
from fcslam.maps.tiles import DEEPEST_ZOOM, finest_zoom, tile_png
from fcslam.runs import CONFIG, METRICS, POSE_GRAPH, QUALITY, TRAJECTORIES
from fcslam.service.authentication import VIEWERS
from fcslam.service.http.responses import (
    MapSummary,
    MapVerdictSummary,
    file_of,
    refusals,
    response_of,
    unless_known,
)
from fcslam.service.http.robots import Name
from fcslam.service.http.state import ViewerState
from fcslam.service.map_layers import MapLayer, MapShape, layers_of, map_shapes, walls_of
from fcslam.service.viewed_mission import run_of
from fcslam.untrusted import open_file, read_bytes

MOST = 2**31 - 1
"""Largest number of a map or tile."""
Index = Annotated[int, PathParameter(ge=0, le=MOST)]
Square = Annotated[int, PathParameter(ge=-MOST, le=MOST)]
TEXT, JSON = "text/plain", "application/json"
MEDIA = {
    "png": "image/png",
    "pgm": "image/x-portable-graymap",
    "yaml": "application/yaml",
    "svg": "image/svg+xml",
    "tif": "image/tiff",
    "zip": "application/zip",
    "ply": "application/octet-stream",
}

_OBJECT: dict[str, Any] = {"type": "object"}
_ROWS = {"type": "array", "items": _OBJECT | {"required": ["name", "value", "unit"]}}
FILES = (
    (METRICS, JSON, _ROWS, "All metrics with their units."),
    (
        QUALITY,
        JSON,
        _OBJECT,
        "The certificate of each map, by its number; of a live map about half a minute old.",
    ),
    (CONFIG, MEDIA["yaml"], _OBJECT, "The complete configuration."),
    (POSE_GRAPH, TEXT, None, "The pose graph."),
)
"""Files of the run that are sent as they are: name, media type, schema, and what they are."""
_SHAPES = TypeAdapter(list[MapShape])


def map_router(state: ViewerState) -> APIRouter:
    """What each map is, and the run's files."""
    router = APIRouter(tags=["maps"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    @router.get("/maps")
    def get_maps() -> list[MapSummary]:
        """The robots of each map."""
        robots, folder = run_of(state.mission).trajectories.values(), state.mission.run_folder
        return [
            MapSummary(
                map=k,
                floor=floor,
                robots=[r.robot for r in robots if r.map_index == k],
                **_tiling(folder, map_stem(k)),
                layers=layers_of(state.mission, k),
                in_space=folder is not None and (folder / f"{map_stem(k)}.ply").is_file(),
                georeferenced=folder is not None and earth_frame(folder, k) is not None,
            )
            for k, floor in sorted({robot.map_index: robot.floor for robot in robots}.items())
        ]

    @router.get("/verdicts")
    def get_verdicts() -> list[MapVerdictSummary]:
        """Whether to use each map, why, and what to do next."""
        return [
            response_of(
                MapVerdictSummary,
                one,
                map=one.map_index,
                sentence=str(one),
                where=one.concerns[0].where if one.concerns else (),
            )
            for one in run_of(state.mission).verdict
        ]

    @router.get("/maps/{k}.{suffix}", **file_of(*MEDIA.values(), refused=(400, 404), is_tagged=True))
    def get_map(
        request: Request, k: Index, suffix: Annotated[str, PathParameter(pattern="^(png|pgm|yaml|svg|tif|zip|ply)$")]
    ) -> Response:
        """A map: png (picture), pgm and yaml (for map_server), zip (both), svg (in metres), tif (GeoTIFF, if the map is
        georeferenced), ply (points, if robots with 3D LiDARs made it).
        """
        if suffix in ("svg", "tif", "zip"):
            content = export_map(_folder_of(state), k, suffix)
        else:
            content = read_bytes(_existing(state, f"{map_stem(k)}.{suffix}"))
        if content is None:
            raise HTTPException(404, f"there is no {map_stem(k)}, or it is not georeferenced")
        return unless_known(request, content, MEDIA[suffix])

    @router.get("/maps/{k}/tiles/{z}/{x}/{y}.png", **file_of(MEDIA["png"], refused=(400, 404), is_tagged=True))
    def get_tile(
        request: Request, k: Index, z: Annotated[int, PathParameter(ge=0, le=DEEPEST_ZOOM)], x: Square, y: Square
    ) -> Response:
        """A square of a map: at zoom z it has 512 m / 2^z; x and y count squares from the origin, y upwards."""
        try:
            tile = tile_png(_folder_of(state), map_stem(k), z, x, y)
        except FileNotFoundError as error:
            raise HTTPException(404, f"there is no {map_stem(k)}") from error
        return unless_known(request, tile, MEDIA["png"])

    turn = asyncio.Lock()  # one at a time: changes take all packets and several maps, an archive all its files

    @router.get(
        "/maps/{k}/layers/{layer}",
        response_model=list[MapShape],
        responses={**refusals(400), 304: {"description": "as you have it"}},
    )
    async def get_layer(request: Request, k: Index, layer: MapLayer) -> Response:
        """What is drawn over a map: floor plan and deviations, changes since the first day, tags, certificate."""
        async with turn:
            content = await run_in_threadpool(lambda: _SHAPES.dump_json(map_shapes(state.mission, k, layer)))
        return unless_known(request, content, JSON)

    @router.get("/maps/{k}/walls", responses=refusals(400, 404))
    async def get_walls(k: Index) -> dict[str, float]:
        """The direction of most walls of a map: ``direction_rad``, from the x axis, in [-pi/4, pi/4)."""
        try:
            async with turn:
                return await run_in_threadpool(lambda: walls_of(_existing(state, f"{map_stem(k)}.pgm").parent, k))
        except InputError as error:
            raise HTTPException(404, str(error)) from error

    def sender(name: str, media_type: str) -> Callable[[], FileResponse]:
        return lambda: FileResponse(_existing(state, name), media_type=media_type)

    for name, media_type, model, does in FILES:
        described = file_of(media_type, model=model)
        router.add_api_route(f"/{name}", sender(name, media_type), name=name, description=does, **described)

    @router.get(f"/{TRAJECTORIES}.zip", **file_of(MEDIA["zip"]))
    async def get_trajectories() -> Response:
        """The poses of all sessions, a file each."""
        async with turn:
            content = await run_in_threadpool(lambda: _archive(_folder_of(state)))
        return Response(content, media_type=MEDIA["zip"])

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


def _tiling(folder: Path | None, stem: str) -> dict[str, Any]:
    if folder is None or not (folder / f"{stem}.yaml").exists():
        return {"zoom": 0, "extent": None}
    with open_file(folder / f"{stem}.pgm", folder) as image:
        header = image.read(HEADER_BYTES)
    resolution_m, extent_m = area_of(stem, header, read_bytes(folder / f"{stem}.yaml", folder).decode(errors="replace"))
    return {"zoom": finest_zoom(resolution_m), "extent": extent_m}


def _archive(folder: Path) -> bytes:
    """The trajectories of a run folder."""
    try:
        files = {file.name: read_bytes(file, folder) for file in sorted((folder / TRAJECTORIES).glob("*.tum"))}
    except (OSError, ValueError) as error:
        raise HTTPException(404, f"the trajectories cannot be read ({error})") from error
    if not files:
        raise HTTPException(404, "there are no trajectories")
    return zipped(files)


def _folder_of(state: ViewerState) -> Path:
    folder = state.mission.run_folder
    if folder is None:
        raise HTTPException(404, "there is no map yet")
    return folder


def _existing(state: ViewerState, name: str) -> Path:
    folder = _folder_of(state)
    try:
        open_file(folder / name, folder).close()
    except OSError as error:
        raise HTTPException(404, f"there is no {name} that can be read ({error.strerror or error})") from error
    return folder / name
