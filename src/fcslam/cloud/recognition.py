"""Place recognition of the fleet: which stored places may a new one show again, and which are kept."""

from collections.abc import Callable, Collection
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.sessions import robot_of
from fcslam.cloud.settings import FleetConfig
from fcslam.cloud.submaps import SubmapCache
from fcslam.cloud.visits import Visit, visits_near
from fcslam.geometry import se2
from fcslam.geometry.thinning import surplus_places
from fcslam.places.matcher import PlaceMatch, PlaceMatcher
from fcslam.records import Channel, FloatArray, KeyscanId, Place


class VocabularyState(NamedTuple):
    """How far one vocabulary has grown."""

    channel: Channel
    detector_version: str
    words: int
    places: int
    """Places that can be retrieved."""


_VocabularyKey = tuple[Channel, str]
"""Channel and detector version; words of different channels or detectors are never compared."""


class PlaceRecognition:
    """One matcher for each channel and detector version."""

    def __init__(self, config: FleetConfig, seed: int, sessions: SessionStore, graph: JointGraph) -> None:
        self._config = config
        self._seed = seed
        self._sessions = sessions
        self._graph = graph
        self._submaps = SubmapCache(sessions, graph, config.submaps_kept)
        self._matchers: dict[_VocabularyKey, PlaceMatcher] = {}
        self._places: dict[tuple[_VocabularyKey, str], list[KeyscanId]] = {}
        """By vocabulary and session."""

    def match(self, place: Place, mates: Collection[str]) -> list[PlaceMatch]:
        """Compare a new place with the stored ones and store it (Algorithm 1).

        ``mates`` are the sessions that share its map, its own included. The keyscans of the place's submap are held.
        """
        key = place.channel, place.detector_version
        matcher = self._matcher(key)
        matches = matcher.match(place, self._predicted(place, mates), _outside(mates))
        self._places.setdefault((key, place.id.robot), []).append(place.id)
        return matches

    def thin(self, place: Place, mates: Collection[str]) -> None:
        """Forget the oldest places of the robot's sessions in one map where it has very many."""
        settings, matcher = self._config.matcher, self._matchers[place.channel, place.detector_version]
        if len(matcher) <= settings.most_nearby:
            return
        sessions = {session for session in mates if robot_of(session) == robot_of(place.id.robot)}
        ids = [i for i in matcher if i.robot in sessions]
        positions = np.array([self._graph.pose(i)[:2] for i in ids])
        for row in surplus_places(positions, settings.nearby_m, settings.most_nearby):
            matcher.forget(ids[row])

    def vocabularies(self) -> tuple[VocabularyState, ...]:
        """The state of every vocabulary."""
        return tuple(
            VocabularyState(channel, version, matcher.word_count, len(matcher))
            for (channel, version), matcher in self._matchers.items()
        )

    def _matcher(self, key: _VocabularyKey) -> PlaceMatcher:
        if key not in self._matchers:
            rng = np.random.default_rng(self._seed)
            self._matchers[key] = PlaceMatcher(
                self._config.matcher, self._submaps.of, rng, self._forget, self._submaps.noise_of
            )
        return self._matchers[key]

    def _forget(self, place: Place) -> None:
        """DetectorUpdate what only a place needs that is never compared again."""
        self._places[(place.channel, place.detector_version), place.id.robot].remove(place.id)
        self._submaps.drop(place)
        self._sessions.release(place)

    def _predicted(self, place: Place, mates: Collection[str]) -> dict[KeyscanId, FloatArray]:
        """T_i_j (3,) to the nearest places of other sessions in the map: one for each visit, few for each robot."""
        pose, key = self._graph.pose(place.id), (place.channel, place.detector_version)
        visits: dict[str, list[Visit]] = {}
        for session in mates:
            ids = self._places.get((key, session), []) if session != place.id.robot else []
            poses = np.array([self._graph.pose(i) for i in ids]).reshape(-1, 3)
            visits.setdefault(robot_of(session), []).extend(visits_near(ids, poses, pose[:2], self._config.sight_m))
        nearest = (sorted(found, key=itemgetter(0))[: self._config.near_visits] for found in visits.values())
        return {i: se2.between(self._graph.pose(i), pose) for found in nearest for _, i in found}


def _outside(mates: Collection[str]) -> Callable[[KeyscanId], bool]:
    """Whether a place belongs to a session in another map."""
    known = frozenset(mates)
    return lambda place: place.robot not in known
