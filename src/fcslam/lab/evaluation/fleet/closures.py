"""Which closures of a run are of each stage, and which poses they join."""

from collections.abc import Mapping
from enum import StrEnum

import numpy as np

from fcslam.metrics.closures import Mask, Rows
from fcslam.metrics.relations import PoseTable
from fcslam.records import ClosureStatus
from fcslam.runs import Run

STAGES: Mapping[ClosureStatus, frozenset[ClosureStatus]] = {
    ClosureStatus.CANDIDATE: frozenset(ClosureStatus),
    ClosureStatus.VERIFIED: frozenset(ClosureStatus) - {ClosureStatus.CANDIDATE},
    ClosureStatus.ACCEPTED: frozenset({ClosureStatus.ACCEPTED}),
}
"""Final statuses of the closures that passed each stage. Rejected and revoked closures were verified before. Revoked
closures do not count as accepted, because the final graph does not contain them."""

DISCARDED = (ClosureStatus.REJECTED, ClosureStatus.REVOKED)
"""Statuses of discarded closures, which are reported beside the stages."""


class ClosureScope(StrEnum):
    """Whether a closure connects poses of one robot or of two robots."""

    ROBOT = "intra_robot"
    FLEET = "inter_robot"


def closure_rows(run: Run, poses: PoseTable) -> Rows:
    """Rows of both ends of each closure in ``poses``, shape (K, 2); -1 if a stamp is missing or ambiguous."""
    robots = {robot: number for number, robot in enumerate(run.trajectories)}
    rows = np.full((len(run.closures), 2), -1, dtype=np.int64)
    for end, names, stamps in (
        (0, [c.robot_i for c in run.closures], [c.stamp_i for c in run.closures]),
        (1, [c.robot_j for c in run.closures], [c.stamp_j for c in run.closures]),
    ):
        numbers = np.array([robots.get(name, -1) for name in names], dtype=np.int64)
        for number in np.unique(numbers[numbers >= 0]):
            of_robot = np.flatnonzero(poses.robots == number)
            table = PoseTable.of(poses.stamps[of_robot], poses.T_map_base[of_robot])
            asked = np.flatnonzero(numbers == number)
            found = table.find(np.array(stamps)[asked])
            rows[asked, end] = np.where(found >= 0, of_robot[found], -1)
    return rows


def closure_sets(run: Run) -> dict[tuple[ClosureScope, ClosureStatus], Mask]:
    """Masks (K,) of the closures of each stage, and of discarded closures."""
    between = np.array([c.robot_i != c.robot_j for c in run.closures], dtype=np.bool_)
    sets: dict[tuple[ClosureScope, ClosureStatus], Mask] = {}
    for within, kind in ((ClosureScope.ROBOT, ~between), (ClosureScope.FLEET, between)):
        for status in (*STAGES, *DISCARDED):
            passed = STAGES.get(status, {status})
            sets[within, status] = kind & np.array([c.status in passed for c in run.closures], dtype=np.bool_)
    return sets
