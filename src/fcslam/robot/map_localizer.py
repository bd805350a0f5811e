"""Localization of one robot in a finished map, which does not change.

The robot tracks its scans as always (``fcslam.robot.frontend``); this takes the place of the back end. Until the pose
in the map is known, the walls around the newest keyscans are aligned with the map exhaustively. An alignment counts
only if it is clearly better than the best one elsewhere, and the less clear it is, the more stretches must agree. So a
robot in a building that the map does not show stays without a pose. From then on every keyscan is matched with the
map, and the walls are compared with it now and then. A robot that sees other walls than the map is not localized any
more, and the search begins again.
"""

from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from fcslam.geometry import se2
from fcslam.graph.evidence import AGREES_M, AGREES_RAD
from fcslam.lidar.evidence import CLEAR
from fcslam.lidar.frontend import POINT_INFORMATION_SHARE, SUBMAP_REACH_M, MappedKeyscan
from fcslam.lidar.lost import LEAST_OVERLAP, LEAST_RATIO, LEAST_RIVAL_M, LOST_EXPLAINED
from fcslam.lidar.matching import match_scan
from fcslam.lidar.submap import Submap, agreement, build_submap
from fcslam.lidar.tracker import POINT_LIMIT, POINT_SPACING_M, SUPPORTED
from fcslam.lidar.verification import LOOSE
from fcslam.records import FloatArray, frozen
from fcslam.robot.backend import BackendInput, NewKeyscan, Task
from fcslam.wire.messages import Body

FIRST_SIGMA_M, FIRST_SIGMA_RAD = 0.05, 0.01
"""Standard deviations of a pose that the exhaustive search found."""
FIRST_SEARCH_M = 3.0
"""Travel before the first search of the whole map, metres."""
STRETCH_GROWTH = 1.5
"""Length of a stretch, relative to that at the search before."""
LONGEST_STRETCH_M = 15.0
"""Longest stretch whose walls are searched for, metres."""
LEAST_EVIDENCE = 3.0
"""Evidence that fixes the pose, if one of the stretches is clear: the number of separate stretches whose best
alignments agree, plus the least of their ratios, less one."""
MOST_IN_FREE_SPACE = LOOSE.violation
"""Largest share of the walls in free space of the map, or the reverse. The lead of an alignment counts less in
proportion to the walls of the robot there."""
CLEAR_VIOLATION = 0.045
"""Largest share of the walls of a stretch in free space of the map, of one stretch at least: in another building with
such rooms, more of each are."""
CHECK_EVERY_M = 2.0
"""Travel between two comparisons with the map, metres."""
CHECKED_M = SUBMAP_REACH_M
"""Travel, in metres, whose walls are compared with the map."""
DOUBTED = CLEAR
"""If a smaller share of all walls lies on walls of the map, the pose is compared with the best one elsewhere. Walls
where the map knows nothing count, too: they may all lie in known area at the true pose."""
LOST_IN_FREE_SPACE = 2.0 * MOST_IN_FREE_SPACE
"""A robot that is lost sees a larger share of its walls in free space of the map. It is less than that of keyscans
(``LOST_VIOLATION``): a finished map has no error of the robot's newest poses."""
LARGEST_UNSEEN_M = 20.0
"""Travel without known walls after which the robot is not localized any more, metres."""
INITIAL_ERROR_M, INITIAL_ERROR_RAD = 1.5, 0.5
"""Largest error of a given initial pose, metres and radians."""


@dataclass(frozen=True, slots=True, eq=False)
class MapEstimate:
    """Pose of a robot in the map at its newest keyscan."""

    T_map_odom: FloatArray
    """Pose of the session's ``odom`` frame in the map, shape (3,), metres and radians."""
    covariance: FloatArray
    """Covariance of the keyscan's pose in the map, over (x, y, theta), shape (3, 3)."""
    quality: float
    """Share of the walls that lie on walls of the map, where the map knows the area, in [0, 1]. It is the smaller of
    two shares: of the last metres and of the newest keyscan.
    """


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    T_map_odom: FloatArray
    ratio: float
    """Ratio of its score to the best one elsewhere, its lead less for walls in free space of the map."""
    is_clear: bool
    """Whether few walls of the stretch are in free space of the map."""


class MapLocalizer:
    """Localizes one robot by its keyscans; ``submit`` is the back end of a ``RobotFrontend``. It sends nothing."""

    def __init__(self, frozen_map: Submap, initial: FloatArray | None = None) -> None:
        """Begin without a pose, but perhaps with an ``initial`` one to ``suggest`` (``fcslam.lidar.frozen_map``)."""
        self._map = frozen_map
        self.estimate: MapEstimate | None = None
        """None while the robot does not know where it is in the map."""
        self.fixes = 0
        """How often a search found the robot."""
        self.losses = 0
        """How often the robot was localized and is not any more, ends of sessions included."""
        self._suggested: tuple[FloatArray, float] | None = None
        """``T_map_odom`` that somebody gave, and the travel at which it was given."""
        self._begin()
        if initial is not None:
            self.suggest(initial)

    def suggest(self, T_map_odom: FloatArray) -> None:
        """Try a pose that somebody gives, as by hand: the walls that the robot sees from now on must confirm it.

        Until they do, nothing changes; after ``LONGEST_STRETCH_M`` it is forgotten. ``T_map_odom`` says about where the
        ``odom`` frame of the present session lies in the map, shape (3,), metres and radians.
        """
        newest = self._recent[-1] if self._recent else None
        self._suggested = T_map_odom, 0.0 if newest is None else newest.travel_m
        if newest is not None:
            self._try_suggested(newest)
            self._publish(newest)

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Handle the next input of the front end at once."""
        match input:
            case NewKeyscan():
                self._add(input.keyscan)
            case Task.END_SESSION:
                self._lose()
                self._begin()
        done: Future[list[Body]] = Future()
        done.set_result([])
        return done

    def _begin(self) -> None:
        self._recent: deque[MappedKeyscan] = deque()
        """The keyscans of the last ``LONGEST_STRETCH_M``."""
        self._T_map_base: FloatArray | None = None
        """Pose of the newest keyscan; None: unknown."""
        self._covariance: FloatArray = np.zeros((3, 3))
        self._quality = self._newest_share = 0.0
        """Shares of the walls of the last metres, and of those of the newest keyscan, that lie on walls of the map."""
        self._votes: list[_Vote] = []
        """The alignments of separate stretches that agree so far."""
        self._searched_m = 0.0
        """Travel at the end of the last stretch that voted."""
        self._next_search_m = FIRST_SEARCH_M
        self._checked_m = self._seen_m = 0.0
        """Travel at the last comparison with the map, and at the last one that found known walls."""
        self._suggested = None

    def _add(self, keyscan: MappedKeyscan) -> None:
        before = self._recent[-1] if self._recent else None
        self._recent.append(keyscan)
        while self._recent[0].travel_m < keyscan.travel_m - LONGEST_STRETCH_M:
            self._recent.popleft()
        if self._T_map_base is not None and before is not None:
            # 1. Prediction by the robot's own motion, correction by the map.
            self._T_map_base = self._match(self._predict(self._T_map_base, before, keyscan), keyscan)
            # 2. Compare the newest walls with the map, and now and then all around the robot.
            self._newest_share = self._explained(0.0, self._newest_share)
            if keyscan.travel_m >= self._checked_m + CHECK_EVERY_M:
                self._check(keyscan)
        # 3. Try the pose that somebody gave.
        self._try_suggested(keyscan)
        if self._T_map_base is None and keyscan.travel_m >= self._next_search_m:
            # 4. Without a pose, search the whole map.
            self._search(keyscan)
        self._publish(keyscan)

    def _predict(self, T_map_base: FloatArray, before: MappedKeyscan, keyscan: MappedKeyscan) -> FloatArray:
        predicted = se2.compose(T_map_base, se2.between(before.T_local_base, keyscan.T_local_base))
        dx, dy = predicted[:2] - T_map_base[:2]
        lever = np.array(((1.0, 0.0, -dy), (0.0, 1.0, dx), (0.0, 0.0, 1.0)))
        turn = se2.adjoint((0.0, 0.0, predicted[2]))
        assert keyscan.odometry is not None  # only the first keyscan of a session has no motion
        motion = turn @ np.linalg.inv(keyscan.odometry.information) @ turn.T
        self._covariance = lever @ self._covariance @ lever.T + motion
        return predicted

    def _explained(self, reach_m: float, otherwise: float) -> float:
        """Share of the walls of the last metres that lie on walls of the map; ``otherwise``, if it knows too little."""
        assert self._T_map_base is not None
        found = agreement(self._submap(reach_m), self._map, self._T_map_base)
        return found.explained if found.overlap >= LEAST_OVERLAP else otherwise

    def _match(self, T_map_guess: FloatArray, keyscan: MappedKeyscan) -> FloatArray:
        points = keyscan.points.thinned(POINT_SPACING_M, POINT_LIMIT)
        prior: FloatArray = np.asarray(np.linalg.inv(self._covariance))
        # Errors of neighbouring points are correlated; the match counts them in full, so the prior is scaled instead.
        match = match_scan(points, self._map.field, T_map_guess, prior / POINT_INFORMATION_SHARE)
        if match.explained < SUPPORTED:
            return T_map_guess
        self._covariance = np.asarray(np.linalg.inv(prior + POINT_INFORMATION_SHARE * match.information))
        return match.T_field_base

    def _check(self, keyscan: MappedKeyscan) -> None:
        assert self._T_map_base is not None
        self._checked_m = keyscan.travel_m
        submap = self._submap(CHECKED_M)
        found = agreement(submap, self._map, self._T_map_base)
        if found.overlap >= LEAST_OVERLAP:
            self._seen_m, self._quality = keyscan.travel_m, found.explained
            if found.explained < LOST_EXPLAINED and found.violation > LOST_IN_FREE_SPACE:
                self._lose()
            elif found.count < DOUBTED * len(submap.surface):
                self._contest(self._T_map_base, keyscan, submap)
        elif keyscan.travel_m > self._seen_m + LARGEST_UNSEEN_M:
            self._lose()

    def _contest(self, T_map_base: FloatArray, keyscan: MappedKeyscan, submap: Submap) -> None:
        """Give up a doubtful pose if the walls of the last metres fit clearly better elsewhere."""
        from fcslam.lidar.uniqueness import align_map, best_alignment

        found = best_alignment(self._map, submap, LEAST_RIVAL_M)
        if found is None:
            return
        best, ratio = found
        here_m = align_map(self._map, submap, T_map_base).score_m
        if best.score_m >= LEAST_RATIO * max(LEAST_RIVAL_M, here_m) and best.violation <= MOST_IN_FREE_SPACE:
            self._lose()
            if ratio >= LEAST_RATIO:
                self._vote(best.T_a_b, ratio, submap, keyscan)

    def _submap(self, reach_m: float) -> Submap:
        newest = self._recent[-1]
        kept = [k for k in self._recent if k.travel_m >= newest.travel_m - reach_m]
        return build_submap([(k.points, se2.between(newest.T_local_base, k.T_local_base)) for k in kept])

    def _search(self, keyscan: MappedKeyscan) -> None:
        from fcslam.lidar.uniqueness import best_alignment  # SciPy's transforms take long to load

        length_m = min(keyscan.travel_m - self._searched_m, LONGEST_STRETCH_M)
        submap = self._submap(length_m)
        self._next_search_m = keyscan.travel_m + max(CHECK_EVERY_M, (STRETCH_GROWTH - 1.0) * length_m)
        found = best_alignment(self._map, submap, LEAST_RIVAL_M)
        if found is None:
            return
        best, ratio = found
        if ratio < LEAST_RATIO or best.violation > MOST_IN_FREE_SPACE:
            return
        self._vote(best.T_a_b, ratio, submap, keyscan)

    def _try_suggested(self, keyscan: MappedKeyscan) -> None:
        """Fix the suggested pose if the walls seen since then lie on walls of the map there."""
        if self._suggested is None:
            return
        from fcslam.lidar.uniqueness import align_map

        T_map_odom, given_m = self._suggested
        if keyscan.travel_m > given_m + LONGEST_STRETCH_M:
            self._suggested = None
            return
        guess = se2.compose(T_map_odom, keyscan.T_local_base)
        near = align_map(self._map, self._submap(keyscan.travel_m - given_m), guess)
        off = se2.between(guess, near.T_a_b)
        is_near = np.hypot(off[0], off[1]) <= INITIAL_ERROR_M and abs(off[2]) <= INITIAL_ERROR_RAD
        if is_near and near.score_m >= LEAST_RIVAL_M and near.violation <= MOST_IN_FREE_SPACE:
            self._fix(near.T_a_b, keyscan)

    def _vote(self, T_map_base: FloatArray, ratio: float, stretch: Submap, keyscan: MappedKeyscan) -> None:
        violation = agreement(stretch, self._map, T_map_base).violation
        cleared = 1.0 + max(0.0, 1.0 - violation / MOST_IN_FREE_SPACE) * (ratio - 1.0)
        T_map_odom = se2.compose(T_map_base, se2.inverse(keyscan.T_local_base))
        vote = _Vote(T_map_odom, cleared, violation <= CLEAR_VIOLATION)
        self._votes = [*(other for other in self._votes if self._agree(vote, other, keyscan)), vote]
        evidence = len(self._votes) + min(vote.ratio for vote in self._votes) - 1.0
        if evidence >= LEAST_EVIDENCE and any(vote.is_clear for vote in self._votes):
            self._fix(T_map_base, keyscan)
        self._begin_stretch()

    def _begin_stretch(self) -> None:
        self._searched_m = self._recent[-1].travel_m
        self._next_search_m = self._searched_m + FIRST_SEARCH_M

    def _agree(self, one: "_Vote", other: "_Vote", keyscan: MappedKeyscan) -> bool:
        ends = (se2.compose(vote.T_map_odom, keyscan.T_local_base) for vote in (one, other))
        gap = se2.between(*ends)
        return bool(np.hypot(gap[0], gap[1]) <= AGREES_M and abs(gap[2]) <= AGREES_RAD)

    def _fix(self, T_map_base: FloatArray, keyscan: MappedKeyscan) -> None:
        self.fixes += 1
        self._suggested = None
        self._T_map_base = T_map_base
        self._covariance = np.diag((FIRST_SIGMA_M**2, FIRST_SIGMA_M**2, FIRST_SIGMA_RAD**2))
        self._checked_m = self._seen_m = keyscan.travel_m
        self._quality = agreement(self._submap(CHECKED_M), self._map, T_map_base).explained
        self._newest_share = self._explained(0.0, self._quality)

    def _lose(self) -> None:
        self.losses += self._T_map_base is not None
        self._T_map_base, self._quality = None, 0.0
        self._votes = []
        if self._recent:
            self._begin_stretch()

    def _publish(self, keyscan: MappedKeyscan) -> None:
        if self._T_map_base is None:
            self.estimate = None
            return
        T_map_odom = se2.compose(self._T_map_base, se2.inverse(keyscan.T_local_base))
        quality = min(self._quality, self._newest_share)
        self.estimate = MapEstimate(frozen(T_map_odom), frozen(self._covariance), quality)
