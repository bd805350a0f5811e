"""Routes for viewers: the live run as numbers and as files."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse, Response

import fcslam
from fcslam.cloud.edits import in_force, is_removed, kind_of, undone
from fcslam.cloud.sessions import session_name
from fcslam.errors import EvaluationError
from fcslam.maps.tiles import DEEPEST_ZOOM, finest_zoom, tile_png
from fcslam.records import Channel, ClosureStatus, Edit
from fcslam.runs import CONFIG, METRICS, POSE_GRAPH, TRAJECTORIES, ClosureRow, Run, separations
from fcslam.runs.map_files import HEADER_BYTES, area_of, map_stem
from fcslam.service.closure_submaps import overlay_png
from fcslam.service.http.authentication import Role
from fcslam.service.http.responses import (
    ClosureSummary,
    EditSummary,
    FleetSummary,
    LearningRound,
    MapSeparation,
    MapSummary,
    RobotSummary,
    SessionSummary,
    content,
    refusals,
)
from fcslam.service.http.robots import Name, refused_packets
from fcslam.service.http.state import ViewerState
from fcslam.service.learning_rounds import read_rounds
from fcslam.service.mission_store import MissionStore
from fcslam.service.viewed_mission import viewed_run
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode

MOST = 2**31 - 1
"""Largest number of a map or tile."""
Index = Annotated[int, PathParameter(ge=0, le=MOST)]
Square = Annotated[int, PathParameter(ge=-MOST, le=MOST)]
Stamp = Annotated[float, PathParameter(allow_inf_nan=False, description="of a keyscan, seconds")]
KEPT = {"Cache-Control": "private, max-age=60"}
"""Of what is computed for a request and hardly changes."""
TEXT, JSON = "text/plain", "application/json"
MEDIA = {"png": "image/png", "pgm": "image/x-portable-graymap", "yaml": "application/yaml"}

_ROWS = {"type": "array", "items": {"type": "object", "required": ["name", "value", "unit"]}}
_SETTINGS = {"type": "object"}


def fleet_router(state: ViewerState) -> APIRouter:
    """Robots, closures and vocabularies."""
    router = APIRouter(
        tags=["fleet"], dependencies=state.require(Role.VIEWER, Role.ADMIN), responses=refusals(401, 403, 503, 507)
    )

    @router.get("/fleet")
    def get_fleet() -> FleetSummary:
        """Counts."""
        mission, run = state.mission, _run_of(state)
        counts = mission.packet_counts()
        return FleetSummary(
            mission=mission.name,
            version=fcslam.__version__,
            read_only=state.read_only,
            packets=counts.arrived,
            applied=counts.applied,
            waiting=counts.waiting,
            worker_ready=counts.worker_ready,
            robots=list(run.trajectories),
            maps=len({robot.map_index for robot in run.trajectories.values()}),
            # JSON has no NaN
            metrics={
                name: metric.value if math.isfinite(metric.value) else None for name, metric in run.metrics.items()
            },
        )

    @router.get("/robots")
    def get_robots() -> list[SessionSummary]:
        """All robots' sessions."""
        return [
            robot
            for name in dict.fromkeys(s.robot for s in state.mission.sessions())
            for robot in _sessions(state, name)
        ]

    @router.get("/robots/{robot}", responses=refusals(400, 404))
    def get_robot(robot: Name) -> RobotSummary:
        """One robot's sessions, and packets of it that were refused."""
        sessions = _sessions(state, robot)
        if not sessions:
            raise HTTPException(404, f"there is no robot '{robot}'")
        return RobotSummary(robot=robot, sessions=sessions, refused=refused_packets(state.mission.store, robot))

    @router.get("/closures", response_model=list[ClosureSummary], responses=refusals(400))
    def get_closures(
        request: Request, status: ClosureStatus | None = None, limit: Annotated[int, Query(ge=1, le=10_000)] = 1000
    ) -> Response:
        """The newest closures."""
        return _if_changed(request, _newest_closures(_run_of(state), status, limit), JSON)

    @router.get(
        "/closures/{channel}/{robot_i}/{stamp_i}/{robot_j}/{stamp_j}.png",
        response_class=Response,
        responses={**refusals(400, 404), 200: content(MEDIA["png"])},
    )
    def get_closure_picture(channel: Channel, robot_i: Name, stamp_i: Stamp, robot_j: Name, stamp_j: Stamp) -> Response:
        """Walls around both ends of a closure, laid on each other as it measured them."""
        run = _run_of(state)
        closure = _closure_of(run, channel, robot_i, stamp_i, robot_j, stamp_j)
        try:
            picture = overlay_png(state.mission.store, run, closure)
        except EvaluationError as error:
            raise HTTPException(404, str(error)) from error
        return Response(picture, media_type=MEDIA["png"], headers=KEPT)

    @router.get("/closures/{channel}/{robot_i}/{stamp_i}/{robot_j}/{stamp_j}", responses=refusals(400, 404))
    def get_closure(channel: Channel, robot_i: Name, stamp_i: Stamp, robot_j: Name, stamp_j: Stamp) -> ClosureSummary:
        """One closure as it is now."""
        return _closure(_closure_of(_run_of(state), channel, robot_i, stamp_i, robot_j, stamp_j))

    @router.get("/edits")
    def get_edits() -> list[EditSummary]:
        """All edits, and what undid them."""
        edits = state.mission.store.edits()
        return [edit_summary(edit, undone(edits)) for edit in edits]

    @router.get("/learning")
    def get_learning() -> list[LearningRound]:
        """The rounds of the federated training, oldest first; none if the service knows of no training."""
        return [] if state.learning is None else read_rounds(state.learning)

    @router.get("/vocabulary")
    def get_vocabulary() -> dict[str, float]:
        """Words by channel and detector version."""
        prefix = "words_"
        metrics = _run_of(state).metrics
        return {name.removeprefix(prefix): m.value for name, m in metrics.items() if name.startswith(prefix)}

    return router


def map_router(state: ViewerState) -> APIRouter:
    """The run's files."""
    router = APIRouter(
        tags=["maps"], dependencies=state.require(Role.VIEWER, Role.ADMIN), responses=refusals(401, 403, 503)
    )

    @router.get("/maps")
    def get_maps() -> list[MapSummary]:
        """The robots of each map."""
        robots, folder = _run_of(state).trajectories.values(), state.mission.run_folder
        return [
            MapSummary(
                map=k, floor=floor, robots=[r.robot for r in robots if r.map_index == k], **_tiling(folder, map_stem(k))
            )
            for k, floor in sorted({robot.map_index: robot.floor for robot in robots}.items())
        ]

    @router.get("/separations")
    def get_separations() -> list[MapSeparation]:
        """Why maps of one floor are separate, for every two of them."""
        return [
            MapSeparation(maps=s.maps, candidates=s.candidates, verified=s.verified, explanation=str(s))
            for s in separations(_run_of(state))
        ]

    @router.get(
        "/maps/{k}.{suffix}", response_class=Response, responses={**refusals(400, 404), 200: content(*MEDIA.values())}
    )
    def get_map(k: Index, suffix: Annotated[str, PathParameter(pattern="^(png|pgm|yaml)$")]) -> FileResponse:
        """A map: picture, occupancy, and what map_server needs to know of it."""
        return _file(state, f"{map_stem(k)}.{suffix}", MEDIA[suffix])

    @router.get(
        "/maps/{k}/tiles/{z}/{x}/{y}.png",
        response_class=Response,
        responses={**refusals(400, 404), 200: content(MEDIA["png"]), 304: {"description": "as you have it"}},
    )
    def get_tile(
        request: Request,
        k: Index,
        z: Annotated[int, PathParameter(ge=0, le=DEEPEST_ZOOM)],
        x: Square,
        y: Square,
    ) -> Response:
        """A square of a map: at zoom z it has 512 m / 2^z; x and y count squares from the origin, y upwards."""
        try:
            tile = tile_png(_folder_of(state), map_stem(k), z, x, y)
        except FileNotFoundError as error:
            raise HTTPException(404, f"there is no {map_stem(k)}") from error
        return _if_changed(request, tile, MEDIA["png"])

    @router.get(f"/{METRICS}", response_class=Response, responses={**refusals(404), 200: content(JSON, model=_ROWS)})
    def get_metrics() -> FileResponse:
        """All metrics with their units."""
        return _file(state, METRICS, JSON)

    @router.get(
        f"/{CONFIG}", response_class=Response, responses={**refusals(404), 200: content(MEDIA["yaml"], model=_SETTINGS)}
    )
    def get_config() -> FileResponse:
        """The complete configuration."""
        return _file(state, CONFIG, MEDIA["yaml"])

    @router.get("/pose_graph.g2o", response_class=Response, responses={**refusals(404), 200: content(TEXT)})
    def get_pose_graph() -> FileResponse:
        """The pose graph."""
        return _file(state, POSE_GRAPH, TEXT)

    @router.get(
        "/trajectories/{session}.tum", response_class=Response, responses={**refusals(400, 404), 200: content(TEXT)}
    )
    def get_trajectory(
        session: Name, after: Annotated[int, Query(ge=0, le=MOST)] = 0,
        digest: Annotated[str, Query(pattern="^[0-9a-f]{64}$|^$")] = "",
    ) -> Response:  # fmt: skip
        """Poses of a session's keyscans in its map.

        A client that has the first ``after`` bytes sends the digest that came with them. It gets only the rest if those
        bytes have not changed. ``Fcslam-After`` is the number of omitted bytes; ``Fcslam-Digest`` is the digest of all
        up to now.
        """
        path = _existing(state, f"{TRAJECTORIES}/{session}.tum")
        poses = path.read_bytes()
        known = after if after <= len(poses) and digest == hashlib.sha256(poses[:after]).hexdigest() else 0
        headers = {"Fcslam-After": str(known), "Fcslam-Digest": hashlib.sha256(poses).hexdigest()}
        return Response(poses[known:], media_type=TEXT, headers=headers)

    return router


def edit_summary(edit: Edit, gone: Mapping[int, int]) -> EditSummary:
    """An edit; ``gone`` names the edits that undid others (``fcslam.cloud.edits.undone``)."""
    return EditSummary(
        number=edit.number, kind=kind_of(edit.content), content=asdict(edit.content), author=edit.author,
        time_s=edit.time_s, undone_by=gone.get(edit.number),
    )  # fmt: skip


@lru_cache(maxsize=8)  # many pages ask for the same
def _newest_closures(run: Run, status: ClosureStatus | None, limit: int) -> bytes:
    """The newest closures as JSON."""
    chosen = [closure for closure in run.closures if status in (None, closure.status)]
    summaries = [_closure(closure).model_dump(mode="json") for closure in chosen[-limit:]]
    return json.dumps(summaries, allow_nan=False, separators=(",", ":")).encode()


def _if_changed(request: Request, body: bytes, media_type: str) -> Response:
    """An answer whose body is left out if the client says that it has it (RFC 9110, 13.1.2)."""
    tag = f'"{hashlib.sha256(body).hexdigest()}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type=media_type, headers=headers)


def _closure_of(run: Run, *named: Channel | str | float) -> ClosureRow:
    """The closure with this channel, robot and stamp of i, robot and stamp of j.

    Refuses (HTTPException 404): there is none.
    """
    for c in run.closures:
        if named == (c.channel, c.robot_i, c.stamp_i, c.robot_j, c.stamp_j):
            return c
    raise HTTPException(404, "there is no such closure now")


def _folder_of(state: ViewerState) -> Path:
    """The run folder as it is now.

    Refuses (HTTPException 404): there is none yet.
    """
    folder = state.mission.run_folder
    if folder is None:
        raise HTTPException(404, "there is no map yet")
    return folder


def _run_of(state: ViewerState) -> Run:
    folder = state.mission.run_folder
    return Run({}) if folder is None else viewed_run(folder)


def _file(state: ViewerState, name: str, media_type: str) -> FileResponse:
    return FileResponse(_existing(state, name), media_type=media_type)


def _existing(state: ViewerState, name: str) -> Path:
    """A file of the run folder.

    Refuses (HTTPException 404): there is none.
    """
    path = _folder_of(state) / name
    if not path.is_file():
        raise HTTPException(404, f"there is no {name}")
    return path


def _sessions(state: ViewerState, robot: str) -> list[SessionSummary]:
    store, mapped = state.mission.store, _run_of(state).trajectories
    sessions, changes = [], in_force(store.edits())
    for session in state.mission.sessions(robot):
        name = session_name(robot, session.epoch)
        known, correction = mapped.get(name), store.correction(robot, session.epoch)
        sessions.append(
            SessionSummary(
                robot=robot,
                session=name,
                epoch=session.epoch,
                packets=session.next,
                map=known.map_index if known else None,
                floor=known.floor if known else "",
                path_length_m=known.path_length_m if known else 0.0,
                keyscans=len(known.stamps) if known else 0,
                T_map_base=known.T_map_base[-1].tolist() if known else None,
                T_map_odom=correction.correction.T_map_odom.tolist() if correction else None,
                correction=correction.correction.version if correction else -1,
                quality=correction.correction.quality if correction else 0.0,
                removed=is_removed(name, changes),
                detectors=_detectors(store, robot, session.epoch),
                last_heard_s=state.mission.last_heard_s(robot),
            )
        )
    return sessions


def _detectors(store: MissionStore, robot: str, epoch: int) -> dict[Channel, str]:
    hello = store.newest_hello(robot, epoch)
    body = None if hello is None else decode(hello).body
    return dict(body.detector_versions) if isinstance(body, Hello) else {}


def _tiling(folder: Path | None, stem: str) -> dict[str, Any]:
    """Zoom and extent of a map as in ``MapSummary``."""
    if folder is None or not (folder / f"{stem}.yaml").exists():
        return {"zoom": 0, "extent": None}
    with (folder / f"{stem}.pgm").open("rb") as image:
        header = image.read(HEADER_BYTES)
    area = area_of(stem, header, (folder / f"{stem}.yaml").read_text(encoding="utf-8", errors="replace"))
    return {"zoom": finest_zoom(area.resolution_m), "extent": area.extent_m}


def _closure(closure: ClosureRow) -> ClosureSummary:
    return ClosureSummary(
        robot_i=closure.robot_i, stamp_i=closure.stamp_i, robot_j=closure.robot_j, stamp_j=closure.stamp_j,
        channel=closure.channel, similarity=closure.similarity, T_i_j=closure.T_i_j.tolist(), status=closure.status,
        reason=closure.reason.code, value=closure.reason.value, limit=closure.reason.limit,
        setting=closure.reason.setting, explanation=str(closure.reason),
    )  # fmt: skip
