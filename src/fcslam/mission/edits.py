"""Edits as users give them: checked, and as text. ``cloud.edits`` says how they act."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import chain
from typing import Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from fcslam.cloud.edits import undone
from fcslam.config import one_line
from fcslam.errors import InputError
from fcslam.records import (
    FLOOR,
    NAME,
    Change,
    Cut,
    Edit,
    FloorLabel,
    ManualClosure,
    MapRegion,
    Pin,
    Placement,
    RegionUse,
    Removal,
    Undo,
    Veto,
)
from fcslam.wire.limits import MAXIMUM_EPOCH

LARGEST_M: Final = 1e5
"""Largest magnitude of a coordinate in an edit."""
LEAST_AREA_M2: Final = 1e-6
"""A smaller polygon has no inside."""
MOST_CORNERS: Final = 1000
LONGEST_NAME: Final = 100
LEAST_TOLERANCE: Final = (1e-3, 1e-4)
"""Metres and radians: no hand, map or LiDAR is more precise."""
MOST_TOLERANCE: Final = (1e3, 10.0)
"""Metres and radians: more says nothing."""

_KINDS: Final[dict[str, type[Change | Undo]]] = {
    "veto": Veto,
    "removal": Removal,
    "cut": Cut,
    "pin": Pin,
    "closure": ManualClosure,
    "placement": Placement,
    "region": MapRegion,
    "floor": FloorLabel,
    "undo": Undo,
}
_READERS: Final[dict[str, TypeAdapter[Change | Undo]]] = {kind: TypeAdapter(type_) for kind, type_ in _KINDS.items()}


def check_undo(edits: Sequence[Edit], number: int) -> None:
    """Check that edit ``number`` can be undone."""
    named = next((edit for edit in edits if edit.number == number), None)
    if named is None:
        raise InputError(f"there is no edit {number}; `fcslam edit list` shows all {len(edits)}")
    if isinstance(named.content, Undo):
        raise InputError(f"edit {number} undoes edit {named.content.number}; make that edit again instead")
    if number in (gone := undone(edits)):
        raise InputError(f"edit {number} was undone before, by edit {gone[number]}")


def sessions_of(content: Change | Undo) -> tuple[str, ...]:
    """The sessions, or the robot, that an edit names."""
    match content:
        case Veto() | Pin() | ManualClosure():
            return content.robot_i, content.robot_j
        case Removal():
            return (content.robot,)
        case Cut() | Placement() | MapRegion() | FloorLabel():
            return (content.session,)
        case Undo():
            return ()


def kind_of(content: Change | Undo) -> str:
    """The name of the kind of an edit, such as veto or undo."""
    return next(kind for kind, type_ in _KINDS.items() if isinstance(content, type_))


def edit_json(content: Change | Undo) -> str:
    """The content of an edit as a JSON object, for ``read_edit``."""
    return json.dumps(asdict(content))


def read_edit(kind: str, content: str) -> Change | Undo:
    """The content of an edit of this kind, checked."""
    try:
        _KINDS[kind](**json.loads(content))  # refuses names that the kind does not have
        edit = _READERS[kind].validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"not a valid edit of kind '{kind}' ({where}: {first['msg']})") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"not a valid edit of kind '{kind}' ({type(error).__name__}: {one_line(str(error))})"
        ) from error
    check_edit(edit)
    return edit


def check_edit(content: Change | Undo) -> None:
    """Check the numbers and names of an edit."""
    try:
        json.dumps(asdict(content), allow_nan=False)
    except ValueError as error:
        raise InputError("a number of the edit is not finite") from error
    unnamed = next((name for name in sessions_of(content) if not NAME.fullmatch(name)), None)
    if unnamed is not None:
        raise InputError(f"'{unnamed[:LONGEST_NAME]}' is not a name of a session")
    match content:
        case Removal() if not 0 <= (content.epoch or 0) <= MAXIMUM_EPOCH:
            raise InputError(f"epoch {content.epoch}: it must be from 0 to {MAXIMUM_EPOCH}")
        case Cut() if content.last_s <= content.first_s:
            raise InputError(f"the stretch ends at {content.last_s:.3f} s, before it begins at {content.first_s:.3f} s")
        case ManualClosure():
            _check_closure(content)
        case Placement():
            _check_coordinates(content.pose[:2])
        case MapRegion():
            _check_region(content)
        case FloorLabel() if not FLOOR.fullmatch(content.floor):
            raise InputError(f"floor '{content.floor[:LONGEST_NAME]}' is not 1 to 16 of A-Z a-z 0-9 . _ + -")


def _check_closure(closure: ManualClosure) -> None:
    _check_coordinates(closure.T_i_j[:2])
    if any(
        not least <= given <= most
        for given, least, most in zip(closure.tolerance, LEAST_TOLERANCE, MOST_TOLERANCE, strict=True)
    ):
        (least_m, least_rad), (most_m, most_rad) = LEAST_TOLERANCE, MOST_TOLERANCE
        raise InputError(f"the tolerance must be {least_m} to {most_m:g} m and {least_rad} to {most_rad:g} rad")
    if closure.robot_i == closure.robot_j and closure.stamp_i == closure.stamp_j:
        raise InputError("a closure connects two different keyscans")


def check_polygon(corners: Sequence[tuple[float, float]]) -> None:
    """Check that a polygon of corners (x, y), metres, has an inside."""
    if not 3 <= len(corners) <= MOST_CORNERS:
        raise InputError(f"a polygon has 3 to {MOST_CORNERS} corners, not {len(corners)}")
    _check_coordinates(chain.from_iterable(corners))
    x, y = np.array(corners).T
    x, y = x - x[0], y - y[0]
    if abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) < 2.0 * LEAST_AREA_M2:
        raise InputError("the polygon has no inside; give corners that are not on one line")


def _check_region(region: MapRegion) -> None:
    check_polygon(region.polygon)
    if len(region.name) > LONGEST_NAME or not region.name.isprintable():
        raise InputError(f"a name has at most {LONGEST_NAME} printable characters")
    if region.use is RegionUse.AREA and not region.name.strip():
        raise InputError("an area needs a name")


def _check_coordinates(coordinates: Iterable[float]) -> None:
    if not all(abs(number) <= LARGEST_M for number in coordinates):  # false for NaN
        raise InputError(f"a coordinate is over {LARGEST_M:g} m")
