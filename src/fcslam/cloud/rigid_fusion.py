"""Map fusion to the letter of the paper (FC-SLAM, section III.C): rigid maps aligned by matched points.

"When two valid matching points are obtained", their coordinates in both robots' own maps give the rotation and the
translation between the two, eqs. (5) and (6). The paper says neither which two, nor what becomes of further points.
Here two points are valid if they lie ``APART_M`` or more apart and equally far in both maps, as maps are rigid, and if
the rotation that they give is about that of the headings at either point. The two most similar such matches count.
Matches that agree with their rotation and translation then count as much, by least squares: the two points alone are
off by as much as the robots stood apart. No other closure is asked: two false matches that fit each other turn a whole
map, and the drift within the robots' maps stays. It is here to be compared with the joint graph.

The paper takes the coordinates of the matching places themselves and so equates where the two robots stood. A verified
closure is more precise: the matched point is the position of its keyscan j, and ``T_i_j`` gives it in the other map.
Where words alone decide, no ``T_i_j`` is measured; it is zero, and the two positions are one as in the paper.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fcslam.cloud.closure_log import ClosureEntry
from fcslam.cloud.result import Fusion
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.graph.evidence import DISTINCT_RAD
from fcslam.graph.joint import merge
from fcslam.records import ClosureStatus, FloatArray, LoopClosure, Reason, ReasonCode, frozen

APART_M = 5.0
"""Smallest distance of two points: where words alone decide, each is off by as much as the robots stood apart."""
EQUAL_M = 0.5
"""Largest difference of the distances of two points in both maps. If words alone decide, the robots stood apart."""


_Match = tuple[ClosureEntry, FloatArray]
"""A closure, and one pose that its two robots a and b had, in the own map of each, shape (2, 3); a started first."""


def fuse_rigidly(closures: Iterable[ClosureEntry], T_local_base: Mapping[str, FloatArray]) -> Fusion:
    """Every robot's own map (N, 3) moved as a whole, into the frame of the robot of its map that started first.

    ``T_local_base`` has the robots in the order in which they started. Whatever geometry verified between two robots
    and no veto excludes is a match, including closures that the joint map predicted. The closures that align two maps
    are accepted, the others stay verified; closures within robots keep their status.
    """
    entries = list(closures)
    between = [entry for entry in entries if entry.is_between and not entry.vetoed]
    valid = [entry for entry in between if entry.closure.status is not ClosureStatus.CANDIDATE]
    order = list(T_local_base)
    frames, maps = [se2.IDENTITY for _ in order], list(range(len(order)))
    used: dict[ClosureEntry, Reason] = {}
    for robots, members in _links(valid, T_local_base).items():
        T_a_b = _aligned(members)
        if np.isfinite(T_a_b).all() and merge(frames, maps, order.index(robots[0]), order.index(robots[1]), T_a_b):
            used |= {entry: Reason(ReasonCode.MATCHED_POINT, len(members)) for entry, _ in members}
    T_map_base: dict[str, FloatArray] = {
        robot: frozen(se2.compose(frame, T_local_base[robot])) for robot, frame in zip(order, frames, strict=True)
    }
    shared = [[robot for robot, of in zip(order, maps, strict=True) if of == number] for number in sorted(set(maps))]
    return Fusion(shared, T_map_base, T_local_base, tuple(_closure(entry, used) for entry in entries))


def _links(
    entries: Iterable[ClosureEntry], T_local_base: Mapping[str, FloatArray]
) -> dict[tuple[str, str], list[_Match]]:
    """The matches that align the maps of each pair of robots; pairs with the two most similar ones come first."""
    order = list(T_local_base)
    known: dict[tuple[str, str], list[_Match]] = {}
    two: dict[tuple[str, str], tuple[_Match, _Match]] = {}
    for entry in sorted(entries, key=lambda entry: -entry.closure.similarity):
        i, j = entry.closure.i, entry.closure.j
        T_own_i = T_local_base[i.robot][i.number]
        poses = np.stack((se2.compose(T_own_i, entry.closure.T_i_j), T_local_base[j.robot][j.number]))
        robots = i.robot, j.robot
        if order.index(i.robot) > order.index(j.robot):
            robots, poses = robots[::-1], poses[::-1]
        earlier = known.setdefault(robots, [])
        partner = next((other for other in earlier if _are_valid(poses, other[1])), None)
        if partner is not None and robots not in two:
            two[robots] = partner, (entry, poses)
        earlier.append((entry, poses))
    return {robots: _agreeing(known[robots], points) for robots, points in two.items()}


def _agreeing(matches: Sequence[_Match], two: tuple[_Match, _Match]) -> list[_Match]:
    """The matches that the alignment of two of them lays on each other; these two may each be off by ``EQUAL_M``."""
    T_a_b = _aligned(two)
    poses = np.stack([poses for _, poses in matches])
    off = se2.between(poses[:, 0], se2.compose(T_a_b, poses[:, 1]))
    agree = (np.hypot(off[:, 0], off[:, 1]) <= 2.0 * EQUAL_M) & (np.abs(off[:, 2]) < DISTINCT_RAD)
    # None agrees if a robot claims to be so far away that its two points are one to a computer.
    return [match for match, fits in zip(matches, agree, strict=True) if fits] or list(two)


def _aligned(matches: Sequence[_Match]) -> FloatArray:
    """``T_a_b`` by least squares over matched points: of two points, eqs. (5) and (6). NaN if the points are one."""
    return n_point_alignment(*np.stack([poses[:, :2] for _, poses in matches], axis=1))


def _are_valid(poses: FloatArray, others: FloatArray) -> bool:
    """Whether one rigid motion can lay both poses of one map on those of the other and they give its direction."""
    (x_a, x_b), (y_a, y_b) = (poses - others)[:, :2].T
    apart_a, apart_b = np.hypot(x_a, y_a), np.hypot(x_b, y_b)
    if min(apart_a, apart_b) < APART_M or abs(apart_a - apart_b) > EQUAL_M:
        return False
    line = np.arctan2(y_a, x_a) - np.arctan2(y_b, x_b)
    off = se2.wrap_angle(np.array([pair[0, 2] - pair[1, 2] - line for pair in (poses, others)]))
    return bool(np.abs(off).max() < DISTINCT_RAD)


def _closure(entry: ClosureEntry, used: Mapping[ClosureEntry, Reason]) -> LoopClosure:
    if not entry.is_between or entry.closure.status is ClosureStatus.CANDIDATE:
        return entry.closure
    if entry.vetoed:
        return replace(entry.closure, status=ClosureStatus.REVOKED, reason=Reason(ReasonCode.VETOED))
    reason = used.get(entry)
    if reason is None:
        return replace(entry.closure, status=ClosureStatus.VERIFIED, reason=Reason(ReasonCode.UNUSED))
    return replace(entry.closure, status=ClosureStatus.ACCEPTED, reason=reason)
