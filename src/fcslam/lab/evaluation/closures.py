"""Closures of a run against the ground truth: precision and recall by channel, stage and scope."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from fcslam.geometry import se2
from fcslam.metrics.closures import (
    ClosureErrors,
    Mask,
    Precision,
    Recall,
    Revisits,
    Rows,
    find_revisits,
    precision,
    recall_of,
)
from fcslam.metrics.relations import PoseTable, motion_errors
from fcslam.records import PLACE_CHANNELS, Channel, ClosureStatus
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

BOTH = "both"
CHANNELS: Mapping[str, frozenset[Channel]] = MappingProxyType(
    {**{str(channel): frozenset({channel}) for channel in PLACE_CHANNELS}, BOTH: frozenset(PLACE_CHANNELS)}
)
"""Sets of channels that are scored: each channel alone, and both together."""

LIKE_HEADING_DEG = 45.0
"""Largest difference of headings at which cameras with a common field of view see the same scene."""


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


@dataclass(frozen=True, slots=True)
class FleetClosureScore:
    """Scores of one set of closures against the ground truth."""

    precision: Precision
    recall: Recall
    """Recall of all revisits."""
    recall_like_heading: Recall
    """Recall of the revisits with similar headings."""
    recall_full_precision: Recall
    """Recall of all revisits at 100 % precision: only closures more similar than every wrong one of their channel."""


FleetClosures = Mapping[tuple[ClosureScope, ClosureStatus, str], FleetClosureScore]
"""Scores by scope, stage and name in ``CHANNELS``."""


def score_closures(run: Run, truth: PoseTable) -> FleetClosures:
    """Score all sets of closures. A closure is not covered if the true pose of an end is unknown."""
    sets, pairs = closure_sets(run), closure_rows(run, truth)
    T_i_j = np.array([closure.T_i_j for closure in run.closures]).reshape(-1, 3)
    true, is_known = np.full_like(T_i_j, np.nan), (pairs >= 0).all(axis=1)
    first, second = pairs[is_known].T
    true[is_known] = se2.between(truth.T_map_base[first], truth.T_map_base[second])
    errors = ClosureErrors(*motion_errors(true, T_i_j))
    similarity = np.array([closure.similarity for closure in run.closures])
    of_channel = {
        channel: np.array([c.channel is channel for c in run.closures], dtype=np.bool_) for channel in PLACE_CHANNELS
    }

    def at_full_precision(members: Mask) -> Mask:
        """Members (K,) that are more similar than every wrong member."""
        wrong = members & errors.covered & ~errors.correct
        surer: Mask = members & (similarity > np.max(similarity[wrong], initial=-np.inf))
        return surer

    def recall(members: Mask, revisits: Revisits) -> Recall:
        return recall_of(revisits, pairs[members & errors.correct], truth)

    scores = {}
    for within in ClosureScope:
        across = within is ClosureScope.FLEET
        revisits, alike = find_revisits(truth, across), find_revisits(truth, across, LIKE_HEADING_DEG)
        for status in STAGES:
            for name, channels in CHANNELS.items():
                by_channel = [sets[within, status] & of_channel[channel] for channel in channels]
                members: Mask = np.logical_or.reduce(by_channel)
                surest: Mask = np.logical_or.reduce([at_full_precision(each) for each in by_channel])
                scores[within, status, name] = FleetClosureScore(
                    precision(errors, members),
                    recall(members, revisits),
                    recall(members, alike),
                    recall(surest, revisits),
                )
    return MappingProxyType(scores)
