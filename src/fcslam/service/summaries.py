"""A viewed mission as the page and the REST interface show it: summaries of the run folder and of the store."""

import csv
import json
import math
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, TypeVar

import fcslam
from fcslam.cloud.edits import in_force, is_removed, kind_of, undone
from fcslam.cloud.sessions import session_name
from fcslam.config import StrictModel
from fcslam.errors import InputError
from fcslam.maps.exports import earth_frame, zipped
from fcslam.maps.occupancy_map import HEADER_BYTES, area_of, map_stem
from fcslam.maps.palette import robot_colors
from fcslam.maps.tiles import finest_zoom
from fcslam.mission.mission_store import MissionStore
from fcslam.records import Channel, ClosureStatus, Edit
from fcslam.runs import TRAJECTORIES, ClosureRow, Run, separations
from fcslam.service.http.responses import (
    ClosureSummary,
    EditSummary,
    FleetSummary,
    LearningRound,
    MapJoin,
    MapSeparation,
    MapSummary,
    SessionSummary,
)
from fcslam.service.keyscans import live_pose
from fcslam.service.map_layers import layers_of
from fcslam.service.viewed_mission import ViewedMission, viewed_run
from fcslam.untrusted import open_file, read_bytes

_Model = TypeVar("_Model", bound=StrictModel)
ROUNDS_FILE: Final = "rounds.csv"
"""In the output folder of `fcslam tools federate`."""
MOST_ROUNDS: Final = 10_000
_LOSS = "loss_"
_MEASURES = ("repeatability", "mma_3px", "revisit_recall", "places_found")


def fleet_summary(mission: ViewedMission, read_only: bool, may_edit: bool) -> FleetSummary:
    """Counts; ``read_only``: nobody can change the mission; ``may_edit``: whoever asks can."""
    run, counts, folder = run_of(mission), mission.packet_counts(), mission.run_folder
    return FleetSummary(
        mission=mission.name,
        version=fcslam.__version__,
        read_only=read_only,
        may_edit=may_edit,
        map_age_s=None if folder is None or read_only else max(time.time() - folder.stat().st_mtime, 0.0),
        free_bytes=None if folder is None or read_only else shutil.disk_usage(folder).free,
        packets=counts.arrived,
        applied=counts.applied,
        waiting=counts.waiting,
        worker_ready=counts.worker_ready,
        robots=list(run.trajectories),
        maps=len({robot.map_index for robot in run.trajectories.values()}),
        metrics={name: _finite(metric.value) for name, metric in run.metrics.items()},
    )


def all_sessions(mission: ViewedMission) -> list[SessionSummary]:
    """The sessions of all robots."""
    robots = dict.fromkeys(session.robot for session in mission.sessions())
    return [session for robot in robots for session in sessions_of(mission, robot)]


def sessions_of(mission: ViewedMission, robot: str) -> list[SessionSummary]:
    """The sessions of one robot."""
    store = mission.store
    mapped = {name: known for name, known in run_of(mission).trajectories.items() if len(known.stamps)}
    colors = robot_colors({session_name(*session[:2]) for session in mission.sessions()})
    sessions, changes, heard_s = [], in_force(store.edits()), mission.last_heard_s(robot)
    for session in mission.sessions(robot):
        name = session_name(robot, session.epoch)
        known, correction = mapped.get(name), store.correction(robot, session.epoch)
        pose = known.T_map_base[-1] if known else None
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
                T_map_base=pose.tolist() if pose is not None else None,
                T_map_odom=correction.correction.T_map_odom.tolist() if correction else None,
                correction=correction.correction.version if correction else -1,
                quality=correction.correction.quality if correction else 0.0,
                removed=is_removed(name, changes),
                detectors=_detectors(store, robot, session.epoch),
                last_heard_s=heard_s,
            )
        )
    return sessions


def _detectors(store: MissionStore, robot: str, epoch: int) -> dict[Channel, str]:
    hello = store.newest_hello(robot, epoch)
    return {} if hello is None else dict(hello.detector_versions)


@lru_cache(maxsize=8)  # many pages ask for the same
def newest_closures(run: Run, status: ClosureStatus | None, limit: int) -> bytes:
    """The newest closures as JSON."""
    chosen = [closure for closure in run.closures if status in (None, closure.status)]
    summaries = [closure_summary(closure).model_dump(mode="json") for closure in chosen[-limit:]]
    return json.dumps(summaries, allow_nan=False, separators=(",", ":")).encode()


def closure_summary(closure: ClosureRow) -> ClosureSummary:
    """One closure."""
    reason = closure.reason
    return _shown(
        ClosureSummary,
        closure,
        T_i_j=closure.T_i_j.tolist(),
        reason=reason.code,
        value=reason.value,
        limit=reason.limit,
        setting=reason.setting,
        explanation=str(reason),
    )


def all_edits(mission: ViewedMission) -> list[EditSummary]:
    """All edits, and what undid them."""
    edits = mission.store.edits()
    gone = undone(edits)
    return [edit_summary(edit, gone) for edit in edits]


def edit_summary(edit: Edit, gone: Mapping[int, int]) -> EditSummary:
    """An edit; ``gone`` names the edits that undid others (``fcslam.cloud.edits.undone``)."""
    kind, content = kind_of(edit.content), asdict(edit.content)
    return _shown(EditSummary, edit, kind=kind, content=content, undone_by=gone.get(edit.number))


def map_summaries(mission: ViewedMission) -> list[MapSummary]:
    """The robots of each map."""
    robots, folder = run_of(mission).trajectories.values(), mission.run_folder
    return [
        MapSummary(
            map=k,
            floor=floor,
            robots=[r.robot for r in robots if r.map_index == k],
            **_tiling(folder, map_stem(k)),
            layers=layers_of(mission, k),
            georeferenced=folder is not None and earth_frame(folder, k) is not None,
        )
        for k, floor in sorted({robot.map_index: robot.floor for robot in robots}.items())
    ]


def trajectories_zip(folder: Path) -> bytes | None:
    """The trajectories of a run folder as one archive; None if it has none.

    Raises:
        InputError: one cannot be read.
    """
    try:
        files = {file.name: read_bytes(file, folder) for file in sorted((folder / TRAJECTORIES).glob("*.tum"))}
        return zipped(files) if files else None
    except (OSError, ValueError) as error:
        raise InputError(f"the trajectories cannot be read ({error})") from error


def map_separations(mission: ViewedMission) -> list[MapSeparation]:
    """Why maps of one floor are separate, for every two of them."""
    return [
        _shown(MapSeparation, one, reason=None if one.reason is None else one.reason.code, explanation=str(one))
        for one in separations(run_of(mission))
    ]


def map_joins(mission: ViewedMission) -> list[MapJoin]:
    """On what evidence robots share a map, for every two with closures between them that agree."""
    run = run_of(mission)
    maps = {robot.robot: robot.map_index for robot in run.trajectories.values()}
    measures = "seen_m", "contradicting_m", "likeness", "elsewhere"
    return [
        _shown(
            MapJoin,
            join,
            robots=(join.robot_i, join.robot_j),
            map=maps[join.robot_i],
            explanation=str(join),
            **{name: _finite(getattr(join, name)) for name in measures},
        )
        for join in run.joins
        if maps.get(join.robot_i, -1) == maps.get(join.robot_j)
    ]


def _shown(model: type[_Model], record: object, **more: object) -> _Model:
    """A response with the fields of a record that have the same name, and ``more``."""
    same = {name: getattr(record, name) for name in model.model_fields if name not in more}
    return model.model_validate({**same, **more})


def _finite(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


def _tiling(folder: Path | None, stem: str) -> dict[str, Any]:
    if folder is None or not (folder / f"{stem}.yaml").exists():
        return {"zoom": 0, "extent": None}
    with open_file(folder / f"{stem}.pgm", folder) as image:
        header = image.read(HEADER_BYTES)
    area = area_of(stem, header, read_bytes(folder / f"{stem}.yaml", folder).decode(errors="replace"))
    return {"zoom": finest_zoom(area.resolution_m), "extent": area.extent_m}


def read_rounds(folder: Path) -> list[LearningRound]:
    """The rounds so far, oldest first; none before the first one is done.

    Raises:
        InputError: the table is damaged.
    """
    path = folder / ROUNDS_FILE
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [_round(row) for row, _ in zip(csv.DictReader(file), range(MOST_ROUNDS), strict=False)]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: is not a table of rounds ({error})") from error


def _round(row: dict[str, str]) -> LearningRound:
    numbers = {
        name: float(text) for name, text in row.items() if (name.startswith(_LOSS) or name in _MEASURES) and text
    }
    known = {name: number for name, number in numbers.items() if math.isfinite(number)}
    return LearningRound(
        round=int(row["round"]),
        version=row["version"],
        released=row["released"] == "1",
        robots=[robot for robot in row["robots"].split(" | ") if robot],
        left_out=row["left_out"],
        reason=row.get("reason") or "",
        losses={name.removeprefix(_LOSS): number for name, number in known.items() if name.startswith(_LOSS)},
        measures={name: number for name, number in known.items() if name in _MEASURES},
    )


def run_of(mission: ViewedMission) -> Run:
    """The newest run, without its maps; an empty one before the first one is written."""
    folder = mission.run_folder
    return Run({}) if folder is None else viewed_run(folder)
