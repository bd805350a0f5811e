"""Changes in a mission's building: from a run folder to grids, a picture and a table of changed regions.

Poses come from the run, ranges from its mission file.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fcslam.cloud.sessions import in_session
from fcslam.errors import SourceError, writing
from fcslam.maps.changes import APPEARED, DISAPPEARED, Changes, compare
from fcslam.maps.fusion import Period, fuse_periods, periods_of
from fcslam.maps.occupancy_map import OccupancyMap, server_files
from fcslam.mission.mission_file import SavedMission
from fcslam.records import SAME_STAMP_S, FloatArray, Keyscan, LaserModel
from fcslam.runs import Run
from fcslam.runs.folder import prepare_folder
from fcslam.storage.files import replacing_folder
from fcslam.wire.messages import Hello

TABLE: Final = "changes.csv"
PICTURE: Final = "changes.png"
COLUMNS: Final = ("change", "area_m2", "x", "y", "sessions")


class _Seen(NamedTuple):
    keyscans: list[Keyscan]
    T_map_base: FloatArray  # (N, 3)
    lasers: Mapping[str, Sequence[LaserModel]]


def changes_of(
    run: Run, mission: SavedMission, since: str | None, until: str | None, map_index: int, name: str
) -> Changes:
    """The changes in a map of a run between two times, as in ``fcslam.changes``; messages call the run ``name``.

    Keyscans that are newer than the run are left out.
    """
    seen = _seen(run, mission, map_index, name)
    periods = periods_of(seen.keyscans)
    first = 0 if since is None else _period_at("since", since, periods)
    last = len(periods) - 1 if until is None else _period_at("until", until, periods)
    if first >= last:
        raise SourceError(
            f"nothing to compare: no session between {_named(periods[first])} and {_named(periods[last])}; "
            f"the map has {len(periods)} period{'s' * (len(periods) != 1)}: {'; '.join(map(_named, periods))}"
        )
    config = mission.config.map
    kept = {session for period in periods[: last + 1] for session in period.sessions}
    rows = [k for k, keyscan in enumerate(seen.keyscans) if keyscan.id.robot in kept]
    keyscans = [seen.keyscans[k] for k in rows]
    maps: list[OccupancyMap] = []
    for number, fused in enumerate(
        fuse_periods(keyscans, seen.T_map_base[rows], seen.lasers, config, periods[: last + 1])
    ):
        if number >= first:
            maps.append(fused)
    return compare(maps, periods[first : last + 1])


def save_changes(changes: Changes, folder: Path, force: bool) -> None:
    """Write the changes into a new folder, whole or not at all.

    ``appeared`` and ``disappeared`` are maps for ROS map_server: occupied cells changed, free ones did not.
    """
    place = check_output(folder, force)
    with writing(place, "name another folder"), replacing_folder(place) as staging:
        for kind, mask in ((APPEARED, changes.appeared), (DISAPPEARED, changes.disappeared)):
            for name, content in server_files(kind, changes.layer(mask)).items():
                (staging / name).write_bytes(content)
        (staging / PICTURE).write_bytes(changes.png())
        (staging / TABLE).write_text(_table(changes), encoding="utf-8")


def check_output(folder: Path, force: bool) -> Path:
    """Check, before the work, that changes can be written to ``folder``."""
    return prepare_folder(folder, force, "changes", lambda place: (place / TABLE).is_file())


def _table(changes: Changes) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for region in changes.regions:
        numbers = f"{region.area_m2:.4f}", f"{region.x:.3f}", f"{region.y:.3f}"
        writer.writerow((region.kind, *numbers, " ".join(region.sessions)))
    return text.getvalue()


def _seen(run: Run, mission: SavedMission, map_index: int, name: str) -> _Seen:
    """The keyscans of the run's map and their poses; sessions that are not in it are left out."""
    members = {
        name: robot for name, robot in run.trajectories.items() if robot.map_index == map_index and len(robot.stamps)
    }
    if not members:
        raise SourceError(f"{name}: has no map {map_index}; the first one is 0")
    lasers: dict[str, Sequence[LaserModel]] = {}
    keyscans: list[Keyscan] = []
    poses: list[FloatArray] = []
    for sent in mission.packets.values():
        for sized in sent:
            packet = in_session(sized.packet)
            robot, keyscan = members.get(packet.robot), packet.body
            if robot is not None and isinstance(keyscan, Hello):
                lasers[packet.robot] = keyscan.lasers
            if robot is None or not isinstance(keyscan, Keyscan) or keyscan.stamp > robot.stamps.max() + SAME_STAMP_S:
                continue
            row = robot.nearest(keyscan.stamp)
            if abs(robot.stamps[row] - keyscan.stamp) > SAME_STAMP_S:
                raise SourceError(f"{name}: the trajectory of {packet.robot} has no pose at {keyscan.stamp:.6f} s")
            keyscans.append(keyscan)
            poses.append(robot.T_map_base[row])
    if not keyscans:
        raise SourceError(f"{name}: the mission has no keyscan of map {map_index}; nothing to compare")
    return _Seen(keyscans, np.array(poses), lasers)


def _period_at(option: str, text: str, periods: Sequence[Period]) -> int:
    """Number of the newest period that had ended at a time, or of the period of a session."""
    for number, period in enumerate(periods):
        if text in period.sessions:
            return number
    stamp = _stamp(option, text)
    ended = [number for number, period in enumerate(periods) if period.last_s <= stamp]
    if not ended:
        raise SourceError(f"--{option} {text}: no session had ended by then; the first is {_named(periods[0])}")
    return ended[-1]


def _stamp(option: str, text: str) -> float:
    """Seconds of a stamp, or since 1970 of a date or time."""
    try:
        stamp = float(text)
        if math.isfinite(stamp):
            return stamp
    except ValueError:
        pass
    try:
        moment = datetime.combine(date.fromisoformat(text), time.max)
    except ValueError:
        try:
            moment = datetime.fromisoformat(text)
        except ValueError as error:
            raise SourceError(
                f"--{option} {text[:100]!r}: neither a session of this map, a stamp in seconds nor a date such as "
                "2026-11-23"
            ) from error
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _named(period: Period) -> str:
    return f"{', '.join(period.sessions)} (stamps {period.first_s:.1f} to {period.last_s:.1f})"
