"""The responses of the service, as OpenAPI describes them."""

from collections.abc import Sequence
from hashlib import sha256
from typing import Annotated, Any, TypeVar

from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from fcslam.config import StrictModel
from fcslam.records import Channel, ClosureStatus, ReasonCode
from fcslam.runs import Use
from fcslam.service.map_layers import MapLayer

_Model = TypeVar("_Model", bound=StrictModel)
Point = Annotated[list[float], Field(min_length=2, max_length=2, description="x and y in metres")]
Pose = Annotated[list[float], Field(min_length=3, max_length=3, description="x and y in metres, theta in radians")]


class Problem(StrictModel):
    """Why a request is refused."""

    error: str = Field(description="what, where, what to do: one line")
    index: int = Field(default=0, description="of the refused packet of a batch; those before it are stored")
    backlog: int = Field(default=0, description="if a worker is not ready: packets that arrived without effect yet")


class PacketRefusal(StrictModel):
    """A refused packet; its number is used up."""

    epoch: int
    sequence: int
    reason: str


class RobotState(StrictModel):
    """Where a robot continues after a restart."""

    robot: str
    epoch: int | None = Field(description="newest epoch of the robot")
    next: dict[str, int] = Field(description="by epoch, number of the first packet that is missing")
    correction: int = Field(description="version of the newest correction; -1: none")
    map: int | None = Field(description="number of its map; null: none")
    refusals: int = Field(description="number of its packets that were refused")
    refused: list[PacketRefusal] = Field(description="the last 100 of them")


class FleetSummary(StrictModel):
    """State of the mission."""

    mission: str
    version: str = Field(description="of fcslam; a page of another version must be loaded again")
    read_only: bool = Field(description="whether nobody can change the mission here: it is a finished run")
    may_edit: bool = Field(description="whether whoever asks may change the mission")
    map_age_s: float | None = Field(
        description="seconds since the map was drawn; null before that, and for a finished run"
    )
    lacking_packets: int = Field(description="number of packets that arrived and are not in the map yet")
    lacking_sessions: int = Field(description="number of sessions that are in no map yet, while packets are lacking")
    lacking_s: float = Field(description="seconds since the oldest packet arrived that is not in the map yet; 0: none")
    free_bytes: int | None = Field(description="bytes that are free on the disk of the map; null as for its age")
    packets: int = Field(description="number of packets that arrived")
    applied: int = Field(description="number of packets that took effect")
    waiting: int = Field(description="number of packets that wait for an earlier one")
    worker_ready: bool = Field(description="whether packets and edits take effect now; no: the worker is starting")
    robots: list[str]
    maps: int = Field(description="number of maps")
    metrics: dict[str, float | None] = Field(description="by name; `metrics.json` has their units")


class SessionSummary(StrictModel):
    """One start of a robot with odometry at zero."""

    robot: str
    session: str
    epoch: int = Field(description="number of the start, from 0")
    packets: int = Field(description="number of packets that arrived without a gap")
    map: int | None = Field(description="number of its map; null: not mapped yet")
    floor: str = Field(description="floor that it named; empty: none, or not mapped yet")
    path_length_m: float = Field(description="length of its path in the map, metres")
    keyscans: int = Field(description="number of its poses in the map")
    color: str = Field(description="of the robot in all pictures, as #rrggbb")
    first_s: float | None = Field(description="stamp of the first pose in the map, seconds")
    last_s: float | None = Field(description="stamp of the last pose in the map, seconds")
    T_map_base: Pose | None = Field(
        description="newest pose, x and y in metres, theta in radians; it may be newer than the map"
    )
    z_m: float | None = Field(description="height of the newest pose, metres; null in a map of the plane")
    T_map_odom: Pose | None = Field(description="frame of its odometry in the map, x and y in metres, theta in radians")
    correction: int = Field(description="version of the newest correction; -1: none")
    quality: float = Field(description="how well other sessions support the pose, in [0, 1]; 0: no support")
    removed: bool = Field(description="whether an administrator removed it, so that its packets have no effect")
    detectors: dict[Channel, str] = Field(description="version by channel, as its newest hello names them")
    last_heard_s: float | None = Field(description="seconds since the robot's last batch")
    ended: bool = Field(description="whether the robot said that it ends and has sent everything")


class RobotSummary(StrictModel):
    """One robot's sessions, and packets of it that were refused."""

    robot: str
    sessions: list[SessionSummary]
    refused: list[PacketRefusal] = Field(description="the last 100")


class ClosureSummary(StrictModel):
    """As in closures.csv."""

    robot_i: str
    stamp_i: float = Field(description="of keyscan i, seconds")
    robot_j: str
    stamp_j: float = Field(description="of keyscan j, seconds")
    channel: Channel
    similarity: float = Field(description="share of common words, in [0, 1]")
    T_i_j: Pose = Field(description="pose of j in i, x and y in metres, theta in radians")
    status: ClosureStatus
    reason: ReasonCode
    value: float | None = Field(
        description="the measured value behind the reason, in the unit that the table of reasons gives; null: none"
    )
    limit: float | None = Field(description="the limit of the value, in its unit")
    setting: str = Field(description="the setting that holds the limit; empty without one")
    explanation: str = Field(description="the reason with its numbers, as one clause")


class MapSummary(StrictModel):
    """Which robots share a map."""

    map: int = Field(description="number of the map, from 0")
    floor: str = Field(description="floor that its robots named; empty: none")
    robots: list[str]
    zoom: int = Field(description="number of the zoom of the tiles that show every cell; deeper ones show nothing more")
    extent: tuple[float, float, float, float] | None = Field(
        description="lowest x and y, highest x and y that the map covers, in metres; null before there is a map"
    )
    layers: list[MapLayer] = Field(description="what can be drawn over it")
    in_space: bool = Field(description="whether the map is three-dimensional: it has points, as PLY")
    georeferenced: bool = Field(description="whether its place on the earth is known")


class LearningRound(StrictModel):
    """A round of the federated training of the detector."""

    round: int = Field(description="number of the round, from 1")
    version: str = Field(description="detector after the round")
    released: bool = Field(description="whether it was the best so far, so robots get it")
    robots: list[str] = Field(description="whose updates counted")
    left_out: str = Field(description="whose did not, and why")
    reason: str = Field(description="of the gate for releasing it or not; empty without a gate")
    losses: dict[str, float] = Field(description="by name, without a unit")
    measures: dict[str, float] = Field(description="of the evaluation, in [0, 1]; empty if the round was not evaluated")


class MapVerdictSummary(StrictModel):
    """Whether to use one map, and why."""

    map: int = Field(description="number of the map")
    robots: list[str]
    use: Use = Field(description="`use` it, use it with a `reserve`, or `wait`: do not use it yet")
    sentence: str = Field(description="the decision, its reason, and what to do next")
    details: list[str] = Field(description="further concerns, and what the decision rests on")
    where: list[Point] = Field(description="places to look at, or between which to drive, metres")


class DetectorSummary(StrictModel):
    """A detector that robots may download."""

    channel: Channel
    version: str
    announced: bool = Field(description="whether robots are to use it")


class MissionList(StrictModel):
    """All missions, and which one is open."""

    open: str
    missions: list[str]


class Finalized(StrictModel):
    """A result."""

    number: int
    run: str = Field(description="run folder, on the service's machine")
    archive: str = Field(description="path of the run folder as a ZIP archive, to download from the service")


class EditSummary(StrictModel):
    """An edit: what somebody changed about the mission by hand."""

    number: int = Field(description="number of the edit, from 1")
    kind: str = Field(description="veto, removal, cut, pin, closure, placement, region, floor or undo")
    content: dict[str, Any] = Field(description="what it names")
    author: str
    time_s: float = Field(description="seconds since 1970")
    undone_by: int | None = Field(description="number of the edit that undid it; null: it is in force")


_SECONDS = {"schema": {"type": "integer", "minimum": 0}, "required": True, "description": "seconds"}
_REFUSALS: dict[int, dict[str, Any]] = {
    400: {"description": "what was sent is wrong"},
    401: {
        "description": "no known token, no certificate of a robot",
        "headers": {"WWW-Authenticate": {"schema": {"type": "string"}, "required": True}},
    },
    403: {"description": "it is another role's, or another robot's"},
    404: {"description": "it is not there"},
    409: {"description": "it contradicts what is stored"},
    413: {"description": "too long"},
    429: {"description": "too much at once", "headers": {"Retry-After": _SECONDS}},
    500: {"description": "the cloud failed on it"},
    503: {"description": "not now: the service stops, or has no worker"},
    507: {"description": "the disk is full or broken"},
}


def refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The OpenAPI description of refusals."""
    return {status: {"model": Problem, **_REFUSALS[status]} for status in statuses}


def content(*media_types: str, model: dict[str, Any] | None = None) -> dict[str, Any]:
    """The OpenAPI description of a body; bytes if no schema is given."""
    schema = model or {"type": "string", "format": "binary"}
    return {"content": {media_type: {"schema": schema} for media_type in media_types}}


def file_of(
    *media_types: str, refused: Sequence[int] = (404,), model: dict[str, Any] | None = None, is_tagged: bool = False
) -> dict[str, Any]:
    """Arguments of a route that sends a file; ``is_tagged``: a client that has it gets 304."""
    responses = {**refusals(*refused), 200: content(*media_types, model=model)}
    if is_tagged:
        responses[304] = {"description": "as you have it"}
    return {"response_class": Response, "responses": responses}


def response_of(model: type[_Model], record: object, **more: object) -> _Model:
    """A response with the fields of a record that have the same name, and ``more``."""
    same = {name: getattr(record, name) for name in model.model_fields if name not in more}
    return model.model_validate({**same, **more})


def unless_known(request: Request, body: bytes, media_type: str, **headers: str) -> Response:
    """An answer whose body is left out if the client says that it has it (RFC 9110, 13.1.2)."""
    headers = {"ETag": f'"{sha256(body).hexdigest()}"', "Cache-Control": "private, no-cache", **headers}
    if request.headers.get("if-none-match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type=media_type, headers=headers)
