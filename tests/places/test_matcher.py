"""Place in, M_ij out: words or nearness propose, the submaps decide."""

import numpy as np
import pytest

from fcslam.features.birdseye import describe
from fcslam.geometry import se2
from fcslam.lidar.pair_verification import verify_here
from fcslam.lidar.submap import build_submap
from fcslam.lidar.verification import LOOSE, NO_PRIOR
from fcslam.places import matcher as matcher_module
from fcslam.places.matcher import MatcherConfig, PlaceMatcher
from fcslam.places.motions import Motion
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import Channel, KeyscanId, Place, ReasonCode, frozen
from tests.lidar.worlds import corridor, other_room, room, scan_at

STRANGERS, FRIENDS = (lambda _: True), (lambda _: False)
STEPS = np.array([(0.0, 0.0, 0.0), (0.4, 0.1, 0.1), (0.8, -0.1, 0.2), (1.1, 0.3, -0.2)])
AHEAD = np.array([(float(k), 0.0, 0.0) for k in range(12)])


class Visits:
    """Robots that look around in drawn rooms: each visit is a place, its submap is kept for the matcher."""

    def __init__(self):
        self.submaps = {}
        self.asked = []

    def visit(self, robot, number, world, pose, steps=STEPS):
        rng = np.random.default_rng(number)
        poses = se2.compose(np.array(pose), steps)
        scans = [(scan_at(p, world, noise_m=0.01, rng=rng), s) for p, s in zip(poses, steps, strict=True)]
        submap = build_submap(scans)
        place = Place(KeyscanId(robot, number), Channel.LIDAR, "v", number, number, *describe(submap.surface.points))
        self.submaps[place.id] = submap
        return place

    def matcher(self, **settings):
        return PlaceMatcher(MatcherConfig(**settings), self.submap_of, np.random.default_rng(0))

    def submap_of(self, place):
        self.asked.append(place.id)
        return self.submaps[place.id]


@pytest.fixture
def visits():
    return Visits()


POSE_A, POSE_B = np.array([-1.5, -1.0, 0.2]), np.array([-0.5, 0.4, 2.0])


def test_the_same_room_from_another_pose_is_the_same_place(visits):
    matcher = visits.matcher()
    matcher.match(visits.visit("a", 0, room(), POSE_A), {}, STRANGERS)
    (match,) = matcher.match(visits.visit("b", 0, room(), POSE_B), {}, STRANGERS)
    assert (match.i, match.j, match.predicted) == (KeyscanId("a", 0), KeyscanId("b", 0), False)
    assert match.M
    assert np.all(np.abs(se2.between(se2.between(POSE_A, POSE_B), match.T_i_j)) < (0.03, 0.03, 0.01))
    assert 0.0 < match.similarity <= 1.0
    assert len(matcher) == 2


def test_another_room_is_another_place(visits):
    matcher = visits.matcher()
    matcher.match(visits.visit("a", 0, room(), POSE_A), {}, STRANGERS)
    matches = matcher.match(visits.visit("b", 0, other_room(), (0.5, 0.5, 1.0)), {}, STRANGERS)
    assert not any(match.M for match in matches)


def test_of_many_doubtful_motions_only_the_best_are_verified(visits, monkeypatch):
    """A true motion is verified however many false ones there are; of the false ones, a few are."""
    truth, stored = se2.between(POSE_A, POSE_B), [visits.visit("a", number, room(), POSE_A) for number in range(3)]
    wrong = [se2.compose(truth, (0.0, 0.0, angle)) for angle in np.linspace(0.5, 5.5, 10)]
    verified = []

    def verify(pairs):
        verified.append([np.asarray(pair.T_a_b_guess) for pair in pairs])
        return verify_here(pairs)

    matcher = PlaceMatcher(MatcherConfig(), visits.submap_of, np.random.default_rng(0), verify_pairs=verify)
    for place in stored:
        matcher.match(place, {}, FRIENDS)
    proposed = [Motion(T, NO_PRIOR, 0.1) for T in (*wrong, truth)]
    monkeypatch.setattr(matcher_module, "propose_motions", lambda *_: proposed)
    matches = matcher.match(visits.visit("b", 0, room(), POSE_B), {}, STRANGERS)
    assert [match.M for match in matches] == [True] * 3
    right = [T for T in verified[-1] if np.allclose(T, truth)]
    assert len(right) == 3
    assert len(verified[-1]) == 3 + matcher_module.MOST_DOUBTFUL


def test_a_bare_corridor_may_be_the_same_place_but_fixes_no_pose(visits):
    matcher = visits.matcher()
    first = visits.visit("a", 0, corridor(), (0.0, 0.0, 0.0), AHEAD)
    matcher.match(first, {}, STRANGERS)
    second = visits.visit("b", 0, corridor(), (3.0, 0.1, 0.05), AHEAD)
    (match,) = matcher.match(second, {first.id: np.array([3.0, 0.1, 0.05])}, FRIENDS)
    assert match.M
    assert not match.informative


def test_where_a_map_is_shared_the_prediction_is_refined(visits):
    matcher = visits.matcher()
    first = visits.visit("a", 0, room(), POSE_A)
    matcher.match(first, {}, STRANGERS)
    guess = se2.between(POSE_A, POSE_B) + np.array([0.15, -0.1, 0.05])
    (match,) = matcher.match(visits.visit("b", 0, room(), POSE_B), {first.id: guess}, FRIENDS)
    assert match.predicted
    assert match.M
    assert np.all(np.abs(se2.between(se2.between(POSE_A, POSE_B), match.T_i_j)) < (0.03, 0.03, 0.01))


def test_a_wrong_prediction_or_start_does_not_become_a_closure(visits):
    matcher = visits.matcher()
    first = visits.visit("a", 0, room(), POSE_A)
    matcher.match(first, {}, STRANGERS)
    (match,) = matcher.match(visits.visit("b", 0, other_room(), POSE_B), {first.id: np.zeros(3)}, FRIENDS)
    assert not match.M
    assert match.reason.code is not ReasonCode.VERIFIED
    assert not matcher.match_at(visits.visit("c", 0, other_room(), POSE_B), {first.id: np.zeros(3)})


def test_a_known_start_needs_fewer_points(visits):
    asked = []

    def verify(pairs):
        asked.extend(pair.loose.count for pair in pairs)
        return verify_here(pairs)

    truth = se2.between(POSE_A, POSE_B)
    first, second = visits.visit("a", 0, room(), POSE_A), visits.visit("b", 0, room(), POSE_B)
    matcher = PlaceMatcher(MatcherConfig(), visits.submap_of, np.random.default_rng(0), verify_pairs=verify)
    matcher.match(first, {}, STRANGERS)
    (match,) = matcher.match_at(second, {first.id: se2.compose(truth, (0.2, -0.2, 0.05))})
    assert np.all(np.abs(se2.between(truth, match.T_i_j)) < (0.03, 0.03, 0.01))
    assert not match.predicted
    assert asked[-1] == round(LOOSE.count / 3)


def test_a_robot_alone_is_never_compared(visits):
    matcher = visits.matcher()
    for number in range(3):
        assert matcher.match(visits.visit("a", number, room(), POSE_A), {}, FRIENDS) == []
    assert visits.asked == []
    assert len(matcher) == 3


def test_a_place_without_features_matches_nothing_and_harms_nothing(visits):
    matcher = visits.matcher(small_fleet=0, vocabulary=VocabularyConfig(train_batch=1))
    empty = Place(
        KeyscanId("c", 0), Channel.LIDAR, "v", 0, 0, frozen(np.zeros((0, 2)), np.float32),
        frozen(np.zeros((0, 32)), np.uint8),
    )  # fmt: skip
    assert matcher.match(empty, {}, STRANGERS) == []
    matcher.match(visits.visit("a", 0, room(), POSE_A), {}, STRANGERS)
    assert any(m.M for m in matcher.match(visits.visit("b", 0, room(), POSE_B), {}, STRANGERS))


def test_words_choose_the_candidates_of_a_large_fleet(visits):
    """Among twelve visits to another room, one to this: it is among the three that words name."""
    matcher = visits.matcher(small_fleet=0, candidates=3, vocabulary=VocabularyConfig(train_batch=4))
    for number in range(12):
        matcher.match(visits.visit("a", number, other_room(), (0.2 * number - 1, 0.5, number)), {}, STRANGERS)
    matcher.match(visits.visit("a", 12, room(), POSE_A), {}, STRANGERS)
    visits.asked.clear()
    matches = matcher.match(visits.visit("b", 0, room(), POSE_B), {}, STRANGERS)
    assert [match.i for match in matches if match.M] == [KeyscanId("a", 12)]
    assert len(set(visits.asked)) <= 1 + 3


def test_places_from_before_the_first_vocabulary_are_found_by_words(visits):
    matcher = visits.matcher(small_fleet=0, candidates=3, vocabulary=VocabularyConfig(train_batch=4))
    matcher.match(visits.visit("a", 0, room(), POSE_A), {}, FRIENDS)
    for number in range(1, 8):
        matcher.match(visits.visit("a", number, other_room(), (0.3 * number - 1, 0.5, number)), {}, FRIENDS)
    matches = matcher.match(visits.visit("b", 0, room(), POSE_B), {}, STRANGERS)
    assert [match.i for match in matches if match.M] == [KeyscanId("a", 0)]


def test_in_a_joint_map_what_looks_most_alike_is_still_compared(visits):
    """The map may be wrong: likeness, not nearness, chooses whom to doubt it with; its own places do not count."""
    small = VocabularyConfig(train_batch=1)
    matcher = visits.matcher(vocabulary=small)
    matcher.match(visits.visit("a", 0, other_room(), (0.5, 0.5, 1.0)), {}, FRIENDS)
    matcher.match(visits.visit("a", 1, room(), POSE_A), {}, FRIENDS)
    matcher.match(visits.visit("b", 0, room(), POSE_A), {}, FRIENDS)
    far = {KeyscanId("a", 0): np.array([9.0, 9.0, 0.0])}
    matches = matcher.match(visits.visit("b", 1, room(), POSE_B), far, FRIENDS)
    found = [match for match in matches if not match.predicted]
    assert [match.i for match in found] == [KeyscanId("a", 1)]
    assert all(match.M for match in found)


@pytest.mark.parametrize("compares", [True, False], ids=["in words", "waiting"])
def test_of_more_places_than_are_kept_the_oldest_are_forgotten(visits, compares):
    matcher = visits.matcher(most_places=2, vocabulary=VocabularyConfig(train_batch=0))
    oldest = visits.visit("a", 0, room(), POSE_A)
    for place in (oldest, *(visits.visit("a", k, other_room(), (0.3 * k, 0.5, 1.0)) for k in (1, 2))):
        matcher.match(place, {}, (lambda _: compares))
    assert len(matcher) == 2
    visits.asked.clear()
    matches = matcher.match(visits.visit("b", 0, room(), POSE_B), {oldest.id: np.zeros(3)}, STRANGERS)
    assert oldest.id not in visits.asked
    assert not any(match.M for match in matches)
