"""Edits: what users changed about a mission by hand, as a log that only grows; an edit is undone by another one.

An undo is final: whoever regrets it makes the edit again.
"""

from collections.abc import Collection, Iterable, Sequence

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.records import (
    Change,
    Cut,
    Edit,
    FloorLabel,
    ManualClosure,
    MapRegion,
    Pin,
    Placement,
    Removal,
    Undo,
    Veto,
)


def undone(edits: Iterable[Edit]) -> dict[int, int]:
    """By the number of each edit that was undone, the number of the edit that undid it."""
    return {edit.content.number: edit.number for edit in edits if isinstance(edit.content, Undo)}


def in_force(edits: Sequence[Edit]) -> tuple[Change, ...]:
    """The changes that no later edit undid, in their order."""
    gone = undone(edits)
    return tuple(edit.content for edit in edits if not isinstance(edit.content, Undo) and edit.number not in gone)


def is_removed(session: str, changes: Iterable[Change]) -> bool:
    """Whether one of the changes removes the session of this name."""
    robot, epoch = robot_and_epoch(session)
    return any(
        isinstance(change, Removal) and change.robot == robot and change.epoch in (None, epoch) for change in changes
    )


def is_cut(session: str, stamp: float, changes: Iterable[Change]) -> bool:
    """Whether one of the changes cuts the session's keyscan with this stamp."""
    cuts = [change for change in changes if isinstance(change, Cut) and change.session == session]
    return any(cut.first_s <= stamp <= cut.last_s for cut in cuts)


def floors(changes: Iterable[Change]) -> dict[str, str]:
    """The floors that users gave to sessions, by session."""
    return {change.session: change.floor for change in changes if isinstance(change, FloorLabel)}


def needs_new_fleet(before: Collection[Change], now: Collection[Change]) -> bool:
    """Whether these changes act on packets that took effect: a removed session comes back, or one changes its floor."""
    back = {change for change in before if isinstance(change, Removal)} - set(now)
    return bool(back) or floors(before) != floors(now)


def stamps_of(content: Change | Undo) -> tuple[tuple[str, float], ...]:
    """The moments of sessions that an edit names; a cut may reach beyond its session."""
    match content:
        case Veto() | Pin() if content.stamps is not None:
            return (content.robot_i, content.stamps[0]), (content.robot_j, content.stamps[1])
        case ManualClosure():
            return (content.robot_i, content.stamp_i), (content.robot_j, content.stamp_j)
        case Placement() | MapRegion():
            return ((content.session, content.stamp),)
        case _:
            return ()
