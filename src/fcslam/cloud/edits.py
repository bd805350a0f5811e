"""Edits: what users changed about a mission by hand, as a log that only grows; an edit is undone by another one.

An undo is final: whoever regrets it makes the edit again.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from math import isfinite
from typing import Any

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.errors import EditError
from fcslam.records import Change, Edit, Removal, Undo, Veto

_KINDS: dict[str, type[Change | Undo]] = {"veto": Veto, "removal": Removal, "undo": Undo}


def undone(edits: Iterable[Edit]) -> dict[int, int]:
    """By the number of each edit that was undone, the number of the edit that undid it."""
    return {edit.content.number: edit.number for edit in edits if isinstance(edit.content, Undo)}


def in_force(edits: Sequence[Edit]) -> tuple[Change, ...]:
    """The changes that no later edit undid, in their order."""
    gone = undone(edits)
    return tuple(edit.content for edit in edits if not isinstance(edit.content, Undo) and edit.number not in gone)


def check_undo(edits: Sequence[Edit], number: int) -> None:
    """Check that edit ``number`` can be undone.

    Raises:
        EditError: it is not there, is an undo, or was undone before.
    """
    named = next((edit for edit in edits if edit.number == number), None)
    if named is None:
        raise EditError(f"there is no edit {number}; there are {len(edits)}")
    if isinstance(named.content, Undo):
        raise EditError(f"edit {number} undoes edit {named.content.number}; make that edit again instead")
    if number in (gone := undone(edits)):
        raise EditError(f"edit {number} was undone before, by edit {gone[number]}")


def is_removed(session: str, changes: Iterable[Change]) -> bool:
    """Whether one of the changes removes the session of this name."""
    robot, epoch = robot_and_epoch(session)
    return any(isinstance(change, Removal) and change.covers(robot, epoch) for change in changes)


def kind_of(content: Change | Undo) -> str:
    """The name of the kind of an edit: veto, removal or undo."""
    return next(kind for kind, type_ in _KINDS.items() if isinstance(content, type_))


def edit_json(content: Change | Undo) -> str:
    """The content of an edit as a JSON object, for ``read_edit``."""
    return json.dumps(asdict(content))


def read_edit(kind: str, content: str) -> Change | Undo:
    """The content of an edit of this kind.

    Raises:
        EditError: it is not what ``edit_json`` writes.
    """
    try:
        return _read(kind, json.loads(content))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise EditError(f"no edit of kind '{kind}' ({type(error).__name__}: {error})") from error


def _read(kind: str, fields: Any) -> Change | Undo:
    match _KINDS[kind](**fields):
        case Veto(str(i), str(j), None):
            return Veto(i, j)
        case Veto(str(i), str(j), [float() | int() as stamp_i, float() | int() as stamp_j]):
            if isfinite(stamp_i) and isfinite(stamp_j):
                return Veto(i, j, (stamp_i, stamp_j))
        case Removal(str(), None | int()) | Undo(int()) as content:
            return content
    raise ValueError(f"{fields}")
