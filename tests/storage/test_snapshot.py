"""Records that were written to a file are read as the same records."""

import json
from dataclasses import dataclass, fields

import numpy as np
import pytest

from fcslam.records import (
    Channel,
    ClosureStatus,
    FloatArray,
    KeyscanId,
    LoopClosure,
    ManualClosure,
    Reason,
    ReasonCode,
    Tag,
    TagFamily,
    frozen,
)
from fcslam.storage.snapshot import from_state, to_state

CLOSURE = LoopClosure(
    KeyscanId("a", 3),
    KeyscanId("b", 1),
    Channel.LIDAR,
    0.1 + 0.2,
    frozen((1 / 3, -0.0, 1e-300)),
    frozen(np.diag((np.inf, 1.0, np.pi))),
    ClosureStatus.ACCEPTED,
    Reason(ReasonCode.SIMILAR, 0.9, None, "delta"),
    True,
    Tag(TagFamily.APRILTAG_36H11, 7),
)


@dataclass(frozen=True)
class Kept:
    closures: list[LoopClosure]
    pairs: dict[frozenset[str], tuple[int, ...]]
    numbers: set[tuple[int, Channel]]
    by_hand: ManualClosure | None
    pose: FloatArray | None


KEPT = Kept(
    [CLOSURE],
    {frozenset(("a", "b")): (), frozenset(("c",)): (1, 2)},
    {(3, Channel.CAMERA), (1, Channel.LIDAR)},
    ManualClosure("a", 1.0, "b", 6.0, (0.5, 0.0, 0.1), (0.1, 0.1)),
    None,
)


def again(kind, value):
    return from_state(kind, json.loads(json.dumps(to_state(value))))


def test_a_record_comes_back():
    read = again(Kept, KEPT)
    assert (read.pairs, read.numbers, read.by_hand, read.pose) == (KEPT.pairs, KEPT.numbers, KEPT.by_hand, None)
    (closure,) = read.closures
    for field in fields(LoopClosure):
        before, after = getattr(CLOSURE, field.name), getattr(closure, field.name)
        assert type(after) is type(before)
        if isinstance(before, np.ndarray):
            assert (after.dtype, after.tobytes()) == (before.dtype, before.tobytes())
            assert not after.flags.writeable
        else:
            assert after == before


@pytest.mark.parametrize("state", [{}, {"closures": 1}, [], None, {**to_state(KEPT), "by_hand": {"robot_i": "a"}}])
def test_something_else_is_refused(state):
    with pytest.raises((KeyError, TypeError)):
        from_state(Kept, state)


def test_a_value_that_no_enumeration_has_is_refused():
    with pytest.raises(ValueError, match="is not a valid Channel"):
        from_state(set[tuple[int, Channel]], [[1, "radar"]])
