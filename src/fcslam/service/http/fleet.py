"""Routes of viewers about the fleet: robots, closures, edits, learning, and the stream of events."""

import asyncio
import csv
import json
import math
import shutil
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final

from fastapi import APIRouter, Depends, HTTPException, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import Response, StreamingResponse
from starlette.concurrency import run_in_threadpool

import fcslam
from fcslam.cloud.edits import in_force, is_removed, undone
from fcslam.cloud.sessions import session_name
from fcslam.errors import InputError, StoreError
from fcslam.geometry.groups import SE3, group_of
from fcslam.maps.palette import robot_colors
from fcslam.mission.edits import kind_of
from fcslam.records import Channel, ClosureStatus, Edit, FloatArray
from fcslam.runs import ClosureRow, Run
from fcslam.service.authentication import VIEWERS, Role
from fcslam.service.http.responses import (
    ClosureSummary,
    EditSummary,
    FleetSummary,
    LearningRound,
    PacketRefusal,
    Point,
    RobotSummary,
    SessionSummary,
    file_of,
    refusals,
    response_of,
    unless_known,
)
from fcslam.service.http.robots import Name
from fcslam.service.http.state import ViewerState
from fcslam.service.keyscans import live_pose, live_scan, overlay_png
from fcslam.service.viewed_mission import MapLag, ViewedMission, map_lag, run_of
from fcslam.wire.limits import MAXIMUM_EPOCH

EVENTS = "text/event-stream"
MOST_STREAMS = 200
"""Streams at a time: each is looked at four times a second. One more ends the oldest, whose client may ask again."""
LOOK_S = 0.25
"""How often something that waits looks again: a stream for events, a request for its result."""
ROUNDS_FILE: Final = "rounds.csv"
"""In the output folder of `fcslam tools federate`."""
_LOSS = "loss_"
_MEASURES = ("repeatability", "mma_3px", "revisit_recall", "places_found")
_CLOSURE = "/closures/{channel}/{robot_i}/{stamp_i}/{robot_j}/{stamp_j}"

Stamp = Annotated[float, PathParameter(allow_inf_nan=False, description="of a keyscan, seconds")]


def fleet_router(state: ViewerState) -> APIRouter:
    """Robots, closures, edits and learning."""
    router = APIRouter(tags=["fleet"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503, 507))

    @router.get("/fleet")
    def get_fleet(request: Request) -> FleetSummary:
        """State of the mission: counts, age and backlog of the map, free disk space."""
        mission = state.mission
        run, counts, folder = run_of(mission), mission.packet_counts(), mission.run_folder
        is_live = folder is not None and not state.read_only
        lag = MapLag(0, 0, 0.0) if state.read_only else map_lag(mission, time.time())
        return FleetSummary(
            mission=mission.name,
            version=fcslam.__version__,
            read_only=state.read_only,
            may_edit=not state.read_only and state.admits(request, Role.ADMIN),
            map_age_s=max(time.time() - folder.stat().st_mtime, 0.0) if folder is not None and is_live else None,
            lacking_packets=lag.packets,
            lacking_sessions=lag.sessions,
            lacking_s=max(lag.s, 0.0),
            free_bytes=shutil.disk_usage(folder).free if folder is not None and is_live else None,
            packets=counts.arrived,
            applied=counts.applied,
            waiting=counts.waiting,
            worker_ready=counts.worker_ready,
            robots=list(run.trajectories),
            maps=len({robot.map_index for robot in run.trajectories.values()}),
            metrics={name: _finite(metric.value) for name, metric in run.metrics.items()},
        )

    @router.get("/robots")
    def get_robots() -> list[SessionSummary]:
        """All robots' sessions."""
        robots = dict.fromkeys(session.robot for session in state.mission.sessions())
        return [session for robot in robots for session in _sessions_of(state.mission, robot)]

    @router.get("/robots/{robot}", responses=refusals(400, 404))
    def get_robot(robot: Name) -> RobotSummary:
        """One robot's sessions, and packets of it that were refused."""
        sessions = _sessions_of(state.mission, robot)
        if not sessions:
            raise HTTPException(404, f"there is no robot '{robot}'")
        refused = state.mission.store.refusals(robot)
        refusals = [PacketRefusal(epoch=one[0], sequence=one[1], reason=one[2]) for one in refused]
        return RobotSummary(robot=robot, sessions=sessions, refused=refusals)

    @router.get("/closures", response_model=list[ClosureSummary], responses=refusals(400))
    def get_closures(
        request: Request, status: ClosureStatus | None = None, limit: Annotated[int, Query(ge=1, le=10_000)] = 1000
    ) -> Response:
        """The newest closures."""
        return unless_known(request, _newest_closures(run_of(state.mission), status, limit), "application/json")

    def closure_of(channel: Channel, robot_i: Name, stamp_i: Stamp, robot_j: Name, stamp_j: Stamp) -> ClosureRow:
        for c in run_of(state.mission).closures:
            if (channel, robot_i, stamp_i, robot_j, stamp_j) == (c.channel, c.robot_i, c.stamp_i, c.robot_j, c.stamp_j):
                return c
        raise HTTPException(404, "this closure does not exist at present")

    @router.get(f"{_CLOSURE}.png", **file_of("image/png", refused=(400, 404)))
    def get_closure_picture(closure: Annotated[ClosureRow, Depends(closure_of)]) -> Response:
        """Picture of the walls around both ends of a closure, overlaid by its measured pose."""
        try:
            picture = overlay_png(state.mission.store, run_of(state.mission), closure)
        except StoreError:
            raise
        except InputError as error:
            raise HTTPException(404, str(error)) from error
        return Response(picture, media_type="image/png")

    @router.get(_CLOSURE, responses=refusals(400, 404))
    def get_closure(closure: Annotated[ClosureRow, Depends(closure_of)]) -> ClosureSummary:
        """The present state of one closure."""
        return _closure_summary(closure)

    @router.get("/robots/{robot}/scans/{epoch}", responses=refusals(400, 404))
    def get_scan(robot: Name, epoch: Annotated[int, PathParameter(ge=0, le=MAXIMUM_EPOCH)]) -> list[Point]:
        """Points of the newest scan of a session in the robot's base frame, metres; empty before the first scan."""
        points: list[Point] = live_scan(state.mission.store, robot, epoch).round(3).tolist()
        return points

    @router.get("/edits")
    def get_edits() -> list[EditSummary]:
        """All edits, and the edits that undid them."""
        edits = state.mission.store.edits()
        gone = undone(edits)
        return [edit_summary(edit, gone.get(edit.number)) for edit in edits]

    @router.get("/learning")
    def get_learning() -> list[LearningRound]:
        """The rounds of the federated training, oldest first; none if the service knows of no training."""
        return [] if state.learning is None else read_rounds(state.learning)

    return router


def edit_summary(edit: Edit, undone_by: int | None = None) -> EditSummary:
    """An edit as viewers see it."""
    return response_of(EditSummary, edit, kind=kind_of(edit.content), content=asdict(edit.content), undone_by=undone_by)


def _sessions_of(mission: ViewedMission, robot: str) -> list[SessionSummary]:
    store = mission.store
    mapped = {name: known for name, known in run_of(mission).trajectories.items() if len(known.stamps)}
    colors = robot_colors({session_name(*session[:2]) for session in mission.sessions()})
    sessions, changes, heard_s = [], in_force(store.edits()), mission.agents.silent_s(robot)
    for session in mission.sessions(robot):
        name = session_name(robot, session.epoch)
        known, hello = mapped.get(name), store.newest_hello(robot, session.epoch)
        stored = store.correction(robot, session.epoch)
        correction = stored.correction if stored else None
        pose = known.poses[-1] if known else None
        if known and heard_s is not None:  # nobody is heard in a finished run
            pose = live_pose(store, robot, session.epoch, known)
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
                color=f"#{colors[name]:06x}",
                first_s=float(known.stamps[0]) if known else None,
                last_s=float(known.stamps[-1]) if known else None,
                T_map_base=_in_plane(pose) if pose is not None else None,
                z_m=float(pose[2]) if pose is not None and group_of(pose) is SE3 else None,
                T_map_odom=_in_plane(correction.T_map_odom) if correction else None,
                correction=correction.version if correction else -1,
                quality=correction.quality if correction else 0.0,
                removed=is_removed(name, changes),
                detectors=dict(hello.detector_versions) if hello else {},
                last_heard_s=heard_s,
                ended=mission.agents.has_ended(robot),
            )
        )
    return sessions


def _in_plane(pose: FloatArray) -> list[float]:
    """x, y and heading."""
    planar: list[float] = group_of(pose).to_plane(pose).tolist()
    return planar


@lru_cache(maxsize=8)  # many pages ask for the same
def _newest_closures(run: Run, status: ClosureStatus | None, limit: int) -> bytes:
    chosen = [closure for closure in run.closures if status in (None, closure.status)]
    summaries = [_closure_summary(closure).model_dump(mode="json") for closure in chosen[-limit:]]
    return json.dumps(summaries, allow_nan=False, separators=(",", ":")).encode()


def _closure_summary(closure: ClosureRow) -> ClosureSummary:
    reason = closure.reason
    return response_of(
        ClosureSummary,
        closure,
        T_i_j=closure.T_i_j.tolist(),
        reason=reason.code,
        value=reason.value,
        limit=reason.limit,
        setting=reason.setting,
        explanation=str(reason),
    )


def _finite(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


def read_rounds(folder: Path) -> list[LearningRound]:
    """The rounds so far, oldest first; none before the first one is done."""
    path = folder / ROUNDS_FILE
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [_round(row) for row in csv.DictReader(file)]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise InputError(f"{path}: is not a table of rounds ({error})") from error


def _round(row: Mapping[str, str]) -> LearningRound:
    shown = {name: text for name, text in row.items() if text and (name.startswith(_LOSS) or name in _MEASURES)}
    numbers = {name: number for name, text in shown.items() if math.isfinite(number := float(text))}
    return LearningRound(
        round=int(row["round"]),
        version=row["version"],
        released=row["released"] == "1",
        robots=[robot for robot in row["robots"].split(" | ") if robot],
        left_out=row["left_out"],
        reason=row.get("reason") or "",
        losses={name.removeprefix(_LOSS): number for name, number in numbers.items() if name.startswith(_LOSS)},
        measures={name: number for name, number in numbers.items() if name in _MEASURES},
    )


def event_router(state: ViewerState) -> APIRouter:
    """One stream."""
    router = APIRouter(tags=["viewers"], dependencies=state.require(*VIEWERS), responses=refusals(401, 403, 503))

    streams: list[object] = []

    async def lines(request: Request) -> AsyncIterator[str]:
        mine, said, said_s = object(), dict[str, tuple[int, int]](), time.monotonic()
        streams.append(mine)
        del streams[:-MOST_STREAMS]
        try:
            while mine in streams and state.admits(request, *VIEWERS):
                newest = state.events.newest()
                news = [(kind, number) for kind, (_, number) in newest.items() if said.get(kind) != newest[kind]]
                if news or time.monotonic() - said_s >= state.events.beat_s:
                    said, said_s = newest, time.monotonic()
                    told = [f"event: {kind}\ndata: {json.dumps({'number': number})}\n\n" for kind, number in news]
                    yield "".join(told) or ": nothing new\n\n"
                await asyncio.sleep(LOOK_S)
        finally:
            if mine in streams:
                streams.remove(mine)

    @router.get("/events", **file_of(EVENTS, refused=()))
    async def get_events(request: Request) -> StreamingResponse:
        """``live``: there is a new live run; ``finalized``: a result was written. A comment comes at least every 5 s.

        The stream ends when the service stops, or when the token is no longer valid.
        """
        await run_in_threadpool(lambda: state.mission)  # refuses one that there is not, before the stream begins
        return StreamingResponse(lines(request), media_type=EVENTS)

    return router
