"""`fcslam edit`: corrections of a mission by hand. Each is a line of a log, counts in later maps, and can be undone."""

import getpass
import os
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.inputs import numbers
from fcslam.cli.inputs import pose as read_pose
from fcslam.errors import InputError

if TYPE_CHECKING:
    from fcslam.mission.mission_file import SavedMission
    from fcslam.records import Change, Pin, Undo, Veto
    from fcslam.runs import Run

app = typer.Typer(
    no_args_is_help=True,
    help="Correct a mission by hand. An edit counts when you map again: fcslam map --onto RUN -o NEW",
)

_NEGATIVE = {"ignore_unknown_options": True}
"""A corner may begin with a minus."""
_EVER_S = 1e12
"""Begins and ends a stretch without a stamp: no file of edits holds infinities."""

Mission = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder or mission file.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, in whose map you read the coordinates.")]
MapIndex = Annotated[int, typer.Option("--map", min=0, help="Number of the map, as in map_1.png.")]
Polygon = Annotated[
    str, typer.Argument(metavar="CORNERS", help='Corners in the map, metres: "X,Y X,Y X,Y". Two are a rectangle.')
]
Session = Annotated[str, typer.Argument(help="Session, such as anna or anna+1.")]
SessionI = Annotated[str, typer.Argument(metavar="SESSION_I", help="One session, such as anna or anna+1.")]
SessionJ = Annotated[str, typer.Argument(metavar="SESSION_J", help="The other session.")]
StampI = Annotated[float, typer.Argument(metavar="STAMP_I", help="Seconds, as in closures.csv.")]
StampJ = Annotated[float, typer.Argument(metavar="STAMP_J", help="Seconds, of the other session.")]


@app.command("list")
def list_edits(mission: Mission) -> None:
    """List all edits of a mission: number, time, author, change, and what undid it."""
    from fcslam.cloud.edits import undone
    from fcslam.config import one_line
    from fcslam.mission.mission_file import read_mission

    edits = read_mission(mission).edits
    gone = undone(edits)
    for edit in edits:
        when = f"{datetime.fromtimestamp(edit.time_s, UTC):%Y-%m-%d %H:%M:%S} UTC" if edit.time_s else "from the start"
        undoing = f"; undone by edit {gone[edit.number]}" if edit.number in gone else ""
        typer.echo(f"{edit.number}: {_in_words(edit.content)} ({one_line(edit.author)}, {when}{undoing})")
    if not edits:
        typer.echo("no edits")


def _in_words(content: "Change | Undo") -> str:
    from fcslam.cloud.edits import stamps_of
    from fcslam.cloud.sessions import session_name
    from fcslam.mission.edits import kind_of, sessions_of
    from fcslam.records import Cut, FloorLabel, ManualClosure, MapRegion, Placement, Removal, Undo

    moments = [f"{session} at {stamp:.3f} s" for session, stamp in stamps_of(content)]
    words = " and ".join(moments or sessions_of(content))
    match content:
        case ManualClosure(T_i_j=pose) | Placement(pose=pose):
            words += ": ({:.3f} m, {:.3f} m, {:.3f} rad)".format(*pose)
        case MapRegion():
            words = f"{' '.join(filter(None, (content.use, content.name)))}, {len(content.polygon)} corners, by {words}"
        case Removal() if content.epoch is not None:
            words = session_name(content.robot, content.epoch)
        case Cut():
            words += f" from {content.first_s:.3f} s" if content.first_s > -_EVER_S else ""
            words += f" to {content.last_s:.3f} s" if content.last_s < _EVER_S else ""
        case FloorLabel():
            words += f" is on {content.floor}"
        case Undo():
            words = f"edit {content.number}"
    return f"{kind_of(content)}: {words}"


@app.command()
def undo(mission: Mission, number: Annotated[int, typer.Argument(min=1, help="Number in `fcslam edit list`.")]) -> None:
    """Undo an edit. The map is then as if the edit had never been made."""
    from fcslam.records import Undo

    _append(mission, Undo(number))


@app.command()
def veto(
    mission: Mission,
    ends: Annotated[
        list[str],
        typer.Argument(
            metavar="SESSION_I [STAMP_I] SESSION_J [STAMP_J]",
            help="Both ends, as in closures.csv. Without stamps: all closures between the two sessions.",
        ),
    ],
) -> None:
    """Exclude a closure, or all closures between two sessions."""
    from fcslam.records import Veto

    match ends:
        case [session_i, session_j]:
            _decide(mission, Veto(session_i, session_j))
        case [session_i, stamp_i, session_j, stamp_j]:
            _decide(mission, Veto(session_i, session_j, (_number(stamp_i), _number(stamp_j))))
        case _:
            raise InputError("give two sessions, or two sessions each with a stamp: anna 1000.0 ben 1000.001")


@app.command()
def pin(mission: Mission, session_i: SessionI, stamp_i: StampI, session_j: SessionJ, stamp_j: StampJ) -> None:
    """Accept a closure of closures.csv, whatever the other evidence says. It joins maps."""
    from fcslam.records import Pin

    _decide(mission, Pin(session_i, session_j, (stamp_i, stamp_j)))


@app.command()
def close(
    mission: Mission,
    session_i: SessionI,
    stamp_i: StampI,
    session_j: SessionJ,
    stamp_j: StampJ,
    *,
    pose: Annotated[str, typer.Option(metavar="X,Y,THETA", help="Pose of J in I (metres, radians).")],
    tolerance: Annotated[
        str, typer.Option(metavar="M,RAD", help="Standard deviations of the pose (metres, radians).")
    ] = "0.2,0.1",
) -> None:
    """Add a closure: the pose of session J at one time, as seen from session I at another time. It joins maps."""
    from fcslam.records import ManualClosure

    T_i_j, deviations = read_pose("--pose", pose), numbers(tolerance, 2)
    if not deviations:
        raise InputError(f"--tolerance {tolerance!r}: give metres and radians, as in --tolerance 0.2,0.1")
    sigmas = deviations[0], deviations[1]
    _append(mission, ManualClosure(session_i, stamp_i, session_j, stamp_j, T_i_j, sigmas))


@app.command()
def remove(
    mission: Mission,
    session: Annotated[str, typer.Argument(help="A robot, or one of its sessions, such as anna+1 or anna+0.")],
    *,
    first_s: Annotated[float | None, typer.Option("--from", help="Stamp at which the stretch begins.")] = None,
    last_s: Annotated[float | None, typer.Option("--to", help="Stamp at which it ends.")] = None,
) -> None:
    """Remove a robot, a session, or a stretch of a session from the map."""
    from fcslam.cloud.sessions import robot_and_epoch
    from fcslam.records import Cut, Removal

    robot, epoch = robot_and_epoch(session)
    if first_s is None and last_s is None:
        _append(mission, Removal(robot, None if session == robot else epoch))
    else:
        _append(mission, Cut(session, -_EVER_S if first_s is None else first_s, _EVER_S if last_s is None else last_s))


@app.command(context_settings=_NEGATIVE)
def floor(
    mission: Mission,
    session: Session,
    name: Annotated[str, typer.Argument(metavar="FLOOR", help="1 to 16 letters, digits and . _ + -")],
) -> None:
    """Set the floor of a session. The session leaves the maps of other floors."""
    from fcslam.records import FloorLabel

    _append(mission, FloorLabel(session, name))


def _region_command(use: str) -> Callable[..., None]:
    def command(run: RunFolder, corners: Polygon, *, map_index: MapIndex = 0) -> None:
        _draw(run, use, "", corners, map_index)

    return command


for _use, _help in (
    ("erase", "Make a part of the map unknown."),
    ("free", "Mark a part of the map as free, where something stood only for a while."),
    ("keep-out", "Forbid a part of the map: map_keepout.pgm and map_keepout.yaml, the mask of Nav2's keepout filter."),
):
    app.command(_use, help=_help, context_settings=_NEGATIVE)(_region_command(_use))


@app.command(context_settings=_NEGATIVE)
def area(
    run: RunFolder,
    name: Annotated[str, typer.Argument(help="What the area is called.")],
    corners: Polygon,
    *,
    map_index: MapIndex = 0,
) -> None:
    """Name a part of the map: map_areas.geojson."""
    _draw(run, "area", name, corners, map_index)


@app.command()
def place(
    run: RunFolder,
    *,
    to_walls: Annotated[
        bool, typer.Option("--to-walls", help="Turn the map so that its walls run along x and y.")
    ] = False,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="SESSION,STAMP=X,Y,THETA",
            help="A moment of a session and its pose in a floor plan or a georeference (metres, radians).",
        ),
    ] = None,
    match: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y=U,V", help="A point of the map and its target (metres); give two or more."),
    ] = None,
    map_index: MapIndex = 0,
) -> None:
    """Choose the map's coordinate frame: by walls, by a pose, or by points, for example of a floor plan."""
    import numpy as np

    from fcslam.anchoring.walls import wall_direction
    from fcslam.geometry import se2
    from fcslam.mission.map_edits import motion_to_points, moved_map
    from fcslam.records import Placement

    if to_walls + (at is not None) + bool(match) != 1:
        raise InputError("give one of: --to-walls; --at anna,1000.5=3,4,1.57; --match twice or more often")
    if at is not None:
        moment, _, pose = at.partition("=")
        session, _, stamp = moment.rpartition(",")
        _append(run, Placement(session, _number(stamp), read_pose(f"--at {moment}=", pose)))
        return
    opened, mission = _opened(run)
    if match:
        ends = [pair.partition("=")[::2] for pair in match]
        points, targets = ([_point("--match", end[k]) for end in ends] for k in (0, 1))
        T_new_map = motion_to_points(points, targets)
    else:
        walls_rad = wall_direction(opened.maps[map_index]) if map_index in opened.maps else 0.0
        T_new_map = np.array((0.0, 0.0, -walls_rad))
    _append(run, moved_map(opened, mission, map_index, T_new_map))
    if match:
        off_m = np.hypot(*(se2.transform(T_new_map, np.array(points)) - targets).T)
        typer.echo(f"the points fit to {off_m.max():.3f} m", err=True)


def _decide(mission: Path, decision: "Veto | Pin") -> None:
    from fcslam.mission.map_edits import check_closure
    from fcslam.runs import open_run

    if os.path.isdir(mission):
        check_closure(open_run(mission), decision)
    _append(mission, decision)


def _draw(folder: Path, use: str, name: str, corners: str, map_index: int) -> None:
    """Append a region; two corners are those of a rectangle."""
    from fcslam.mission.map_edits import region_in_map
    from fcslam.records import RegionUse

    points = [_point("a corner", corner) for corner in corners.split()]
    if len(points) == 2:
        (left, low), (right, high) = points
        points = [(left, low), (right, low), (right, high), (left, high)]
    run, mission = _opened(folder)
    _append(folder, region_in_map(run, mission, map_index, RegionUse(use), name, points))


def _opened(folder: Path) -> "tuple[Run, SavedMission]":
    from fcslam.mission.mission_file import read_mission
    from fcslam.runs import open_run

    if os.path.isfile(folder):
        raise InputError(f"{folder}: give the run folder; coordinates are read in its map")
    return open_run(folder), read_mission(folder)


def _append(path: Path, content: "Change | Undo") -> None:
    from fcslam.mission.mission_file import edit_mission

    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # no account of this number
        user = "unknown"
    (edit,) = edit_mission(path, [content], user, time.time())
    typer.echo(f"edit {edit.number}; to apply it: fcslam map --onto {path} -o NEW", err=True)


def _point(option: str, text: str) -> tuple[float, float]:
    given = numbers(text, 2)
    if not given:
        raise InputError(f"{option} {text!r} is not a point; give metres, as in 1.5,-2")
    return given[0], given[1]


def _number(text: str) -> float:
    given = numbers(text, 1)
    if not given:
        raise InputError(f"{text!r} is not a number")
    return given[0]
