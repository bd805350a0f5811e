"""Place recognition of the fleet: which stored places may a new one show again, and which are kept."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.closure_log import ClosureLog
from fcslam.cloud.joint_graph import AGREES_SIGMAS, JointGraph
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.sessions import robot_of
from fcslam.cloud.settings import FleetConfig
from fcslam.cloud.space import Space
from fcslam.cloud.submaps import SubmapCache
from fcslam.geometry import se2
from fcslam.geometry.thinning import places_of_old_sessions, surplus_places
from fcslam.lidar.pair_verification import VerifyPairs
from fcslam.places.matcher import PlaceMatch, PlaceMatcher
from fcslam.records import Channel, FloatArray, KeyscanId, Place
from fcslam.storage.state_file import State


class VocabularyState(NamedTuple):
    """How far one vocabulary has grown."""

    channel: Channel
    detector_version: str
    floor: str
    """Empty: that of the sessions that name none."""
    words: int
    places: int
    """Places that can be retrieved."""


_VocabularyKey = tuple[Channel, str, str]
"""Channel, detector version and floor; places that differ in one of these are never compared."""

SIGHT_M = 6.0
"""Largest distance at which places in the same map are compared."""
NEAR_VISITS = 2
"""Earlier visits of each robot that may be compared with a new place."""
COMPARED_VISITS = 3
"""Earlier visits of all robots that are compared with a new place: the work does not grow with the fleet."""
_NO_PLACES = np.empty((0, 2), np.int64)


Visit = tuple[float, KeyscanId]
"""Consecutive places of one session near a point: the distance of the nearest one, metres, and that one."""


class PlaceRecognition:
    """One matcher for each channel, detector version and floor."""

    def __init__(
        self,
        config: FleetConfig,
        seed: int,
        sessions: SessionStore,
        graph: JointGraph,
        space: Space,
        closures: ClosureLog,
        verify_pairs: VerifyPairs,
    ) -> None:
        self._config = config
        self._seed = seed
        self._sessions = sessions
        self._graph = graph
        self._space = space
        self._closures = closures
        self._verify_pairs = verify_pairs
        self.submaps = SubmapCache(graph, space, config.submaps_kept)
        self._matchers: dict[_VocabularyKey, PlaceMatcher] = {}
        self._places: dict[tuple[_VocabularyKey, str], NDArray[np.int64]] = {}
        """Number of the keyscan and of the arrival of each stored place, shape (N, 2), by vocabulary and session."""
        self._arrivals = 0

    def match(self, place: Place, map_sessions: Collection[str]) -> list[PlaceMatch]:
        """Compare a new place with the stored ones and store it (Algorithm 1).

        ``map_sessions`` share its map, its own session included. The keyscans of the place's submap are held.
        """
        key = self._key(place)
        matcher = self._matcher(key)
        by_start = list(self._by_start(place, map_sessions))
        matches = matcher.match(
            place, self._predicted(place, map_sessions), lambda other: other.robot not in map_sessions
        )
        self._enter(key, place.id)
        verified = {match.i for match in matches if match.M}
        at_start = {match.i: match for match in by_start if match.i not in verified}
        found = (*(match for match in matches if match.i not in at_start), *at_start.values())
        return [self._space.match(match) for match in found]

    def match_again(self, a: Collection[str], b: Collection[str]) -> Iterator[tuple[str, list[PlaceMatch]]]:
        """Compare the places of two groups of sessions, which shared a map until now, wherever they were not compared.

        In a false joint map, true pairs of places lie far apart. Yields a session of b with the matches of a place.
        """
        for key, matcher in self._matchers.items():
            stored = {s: self._places.get((key, s), _NO_PLACES)[:, 0].tolist() for s in (*a, *b)}
            others = [KeyscanId(session, number) for session in a for number in stored[session]]
            for place in [KeyscanId(session, number) for session in b for number in stored[session]]:
                new = [i for i in others if not self._closures.has(i, place, key[0])]
                yield place.robot, [self._space.match(match) for match in matcher.match_again(place, new)]

    def thin(self, place: Place, map_sessions: Collection[str]) -> None:
        """Forget the oldest places of the robot in one map where it has very many, and those of its old sessions."""
        key, robot, settings = self._key(place), robot_of(place.id.robot), self._config.matcher
        matcher, sessions = self._matchers[key], [session for session in map_sessions if robot_of(session) == robot]
        if len(matcher) <= settings.most_nearby and len(sessions) <= settings.most_sessions_nearby:
            return
        stored = [self._places.get((key, session), _NO_PLACES) for session in sessions]
        by_arrival = np.argsort(np.concatenate(stored)[:, 1])
        poses = [self._graph.trajectory(session, rows[:, 0]) for session, rows in zip(sessions, stored, strict=True)]
        positions = np.concatenate(poses)[by_arrival, : self._graph.group.axes]
        owners = np.repeat(np.arange(len(sessions)), [len(rows) for rows in stored])[by_arrival]
        numbers = np.concatenate(stored)[by_arrival, 0]
        surplus = surplus_places(positions, settings.nearby_m, settings.most_nearby)
        old = places_of_old_sessions(positions, owners, settings.nearby_m, settings.most_sessions_nearby)
        for row in np.union1d(surplus, old):
            matcher.forget(KeyscanId(sessions[owners[row]], int(numbers[row])))

    def forget(self, sessions: Collection[str]) -> None:
        """Forget all places of the sessions."""
        for matcher in self._matchers.values():
            for place in [place for place in matcher if place.robot in sessions]:
                matcher.forget(place)

    def vocabularies(self) -> tuple[VocabularyState, ...]:
        """The state of every vocabulary."""
        return tuple(VocabularyState(*key, matcher.word_count, len(matcher)) for key, matcher in self._matchers.items())

    def state(self) -> State:
        """The state that ``restore`` needs; ``submaps`` are built again on demand, or restored."""
        return {" ".join(key): matcher.state() for key, matcher in self._matchers.items()}

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        for name, kept in state.items():
            channel, version, floor = name.split(" ")
            key = Channel(channel), version, floor
            matcher = self._matcher(key)
            matcher.restore(kept, Channel(channel), version)
            for place in matcher:
                self._enter(key, place)

    def _key(self, place: Place) -> _VocabularyKey:
        return place.channel, place.detector_version, self._sessions.floor(place.id.robot)

    def _matcher(self, key: _VocabularyKey) -> PlaceMatcher:
        if key not in self._matchers:
            rng = np.random.default_rng(self._seed)
            self._matchers[key] = PlaceMatcher(
                self._config.matcher, self.submaps.of, rng, self._forget, self.submaps.noise_of, self._verify_pairs
            )
        return self._matchers[key]

    def _enter(self, key: _VocabularyKey, place: KeyscanId) -> None:
        stored = self._places.get((key, place.robot), _NO_PLACES)
        self._places[key, place.robot] = np.vstack((stored, (place.number, self._arrivals)))
        self._arrivals += 1

    def _forget(self, place: Place) -> None:
        vocabulary_session = self._key(place), place.id.robot
        stored = self._places[vocabulary_session]
        self._places[vocabulary_session] = stored[stored[:, 0] != place.id.number]
        self.submaps.drop(place)
        self._sessions.release(place)

    def _predicted(self, place: Place, map_sessions: Collection[str]) -> dict[KeyscanId, FloatArray]:
        """T_i_j (3,) to the nearest places of other sessions in the map, one for each visit."""
        pose, key = self._graph.pose(place.id), self._key(place)
        visits: dict[str, list[Visit]] = {}
        for session in map_sessions:
            numbers = self._places.get((key, session), _NO_PLACES)[:, 0]
            if session == place.id.robot or not len(numbers):
                continue
            poses = self._graph.trajectory(session, numbers)
            found = visits_near(session, numbers, poses, pose[: self._graph.group.axes], SIGHT_M)
            if found:
                visits.setdefault(robot_of(session), []).extend(found)
        chosen = worth_comparing(visits.values(), NEAR_VISITS, COMPARED_VISITS)
        group = self._graph.group
        T_i_j = {nearest: group.between(self._graph.pose(nearest), pose) for _, nearest in chosen}
        return {i: self._space.in_plane(T, i, place.id) for i, T in T_i_j.items()}

    def _by_start(self, place: Place, map_sessions: Collection[str]) -> Iterator[PlaceMatch]:
        """Matches with places of other maps that agree with the known starts.

        Starts so far apart that their headings leave open which of two separate places it is tell nothing.
        """
        starts, (sigma_m, sigma_rad), key = self._config.starts, self._config.start_sigma, self._key(place)
        if place.id.robot not in starts:
            return
        T_start_place = self._from_start(place.id.robot, np.array([place.id.number]))[0]
        for session in starts:
            numbers = self._places.get((key, session), _NO_PLACES)[:, 0]
            T_starts = se2.between(starts[session], starts[place.id.robot])
            within_m = AGREES_SIGMAS * float(np.sqrt(2.0) * sigma_m + sigma_rad * np.hypot(*T_starts[:2]))
            if session in map_sessions or not len(numbers) or within_m > self._config.consistency.separation_m:
                continue
            T_start_i = dict(zip(numbers.tolist(), self._from_start(session, numbers), strict=True))
            T_start_j = se2.compose(T_starts, T_start_place)
            visits = visits_near(session, numbers, np.array([*T_start_i.values()]), T_start_j[:2], SIGHT_M)
            nearest = sorted(visits)[:NEAR_VISITS]
            expected = {i: se2.between(T_start_i[i.number], T_start_j) for _, i in nearest}
            for match in self._matcher(key).match_at(place, expected):
                T_start_found = se2.compose(T_start_i[match.i.number], match.T_i_j)
                off = se2.between(T_starts, se2.compose(T_start_found, se2.inverse(T_start_place)))
                if np.hypot(off[0], off[1]) < within_m and abs(off[2]) < AGREES_SIGMAS * np.sqrt(2.0) * sigma_rad:
                    yield match

    def _from_start(self, session: str, numbers: NDArray[np.int64]) -> FloatArray:
        poses = self._graph.group.to_plane(self._graph.trajectory(session))
        return se2.between(poses[0], poses[numbers])


def visits_near(
    session: str, numbers: NDArray[np.int64], T_map_place: FloatArray, point: FloatArray, within_m: float
) -> list[Visit]:
    """The visits of a session to the surroundings of a point (A,), in the plane or in space, in their order.

    ``numbers``: of its places' keyscans (N,), ascending, at the poses (N, P). Near ones in a row are one visit.
    """
    distance = np.linalg.norm(T_map_place[:, : len(point)] - point, axis=1)
    close = np.flatnonzero(distance < within_m)
    stays = np.split(close, np.flatnonzero(np.diff(close) > 1) + 1) if len(close) else []
    visits = []
    for stay in stays:
        nearest = stay[np.argmin(distance[stay])]
        visits.append((float(distance[nearest]), KeyscanId(session, int(numbers[nearest]))))
    return visits


def worth_comparing(visits: Iterable[Sequence[Visit]], of_each: int, most: int) -> list[Visit]:
    """The visits of each robot that a new place is compared with: the nearest ones of different robots first.

    ``of_each`` robot and ``most`` in all are taken: closures to a few robots fix the pose relative to all tied to them.
    """
    nearest = (sorted(found)[:of_each] for found in visits)
    ranked = sorted((rank, visit) for found in nearest for rank, visit in enumerate(found))
    return [visit for _, visit in ranked[:most]]
