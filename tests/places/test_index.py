"""One contract for every strategy and both scores: what is stored is where a walk down the tree ends, always."""

import numpy as np
import pytest
from evaluation.place_features import bag_of_words
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.places.index import PlaceIndex
from fcslam.places.scoring import NEAR_BITS
from fcslam.places.similarity import similarity
from fcslam.places.vocabulary import Scoring, Strategy, TreeConfig, VocabularyConfig

pytestmark = pytest.mark.slow

SMALL = TreeConfig(branching=4, depth=3)
EMPTY = np.empty((0, 32), np.uint8)
EVERY = pytest.mark.parametrize("strategy", list(Strategy))
BOTH = pytest.mark.parametrize("scoring", list(Scoring))


def random_places(rng, count, size=60):
    centres = rng.integers(0, 256, (40, 32), dtype=np.uint8)
    places = []
    for _ in range(count):
        own = centres[rng.choice(40, 6, replace=False)]
        codes = own[rng.integers(0, 6, rng.integers(5, size))]
        places.append(codes ^ np.packbits(rng.random((len(codes), 256)) < 0.03, axis=1))
    return places


def config(strategy, scoring=Scoring.MATCHES, **others):
    chosen = {"train_batch": 3, "capacity": 30, "leaf_capacity": 16, "tree": SMALL}
    return VocabularyConfig(strategy=strategy, scoring=scoring, **{**chosen, **others})


def filled(strategy, scoring=Scoring.MATCHES, seed=0, count=40, **others):
    rng = np.random.default_rng(seed)
    places = dict(enumerate(random_places(rng, count)))
    index = PlaceIndex[int](config(strategy, scoring, **others), rng)
    for number, place in places.items():
        index.add(number, place)
    return index, places


def walk(index, codes):
    """The word of each code by a walk down the tree in plain Python, and all codes of the words around it."""
    vocabulary = index.vocabulary
    tree = vocabulary.tree
    centres = tree.centres.view(np.uint8).reshape(-1, 32)
    vertices = np.zeros(len(codes), np.int64)
    while tree.child_count[vertices].any():
        for vertex in np.unique(vertices[tree.child_count[vertices] > 0]):
            here = np.flatnonzero(vertices == vertex)
            children = np.arange(tree.first_child[vertex], tree.first_child[vertex] + tree.child_count[vertex])
            apart = np.bitwise_count(centres[children] ^ codes[here, None]).sum(axis=2, dtype=int)
            vertices[here] = children[apart.argmin(axis=1)]
    return vocabulary.words[vertices].astype(np.int64)


def walks(index, places):
    """The words of each place."""
    ends = np.cumsum([len(place) for place in places.values()], dtype=int)
    found = walk(index, np.concatenate([EMPTY, *places.values()]))
    return dict(zip(places, np.split(found, ends)[:-1], strict=True))


def words_oracle(index, places, query):
    """Eq. (4) on [0, 1] of the query with every place, with document frequencies counted again."""
    words = walks(index, places)
    own = walk(index, query)
    top = max(int(w.max(initial=0)) for w in (*words.values(), own)) + 1
    documents = np.zeros(top)
    for of_place in words.values():
        documents[np.unique(of_place)] += 1
    idf = np.log(len(places) / np.maximum(documents, 1))
    bags = {number: bag_of_words(of_place, idf, 1) for number, of_place in words.items()}
    return {number: similarity(bag_of_words(own, idf, 1), bag) for number, bag in bags.items()}


def matches_oracle(places, query, near_bits):
    """Every descriptor with every other."""
    gives = {}
    for number, place in places.items():
        distances = np.bitwise_count(query[:, None] ^ place[None]).sum(axis=2, dtype=int).min(axis=1)
        gives[number] = np.where(distances <= near_bits, 1.0 - (distances / (near_bits + 1)) ** 2, 0.0)
    weights = np.log((len(places) + 1) / np.maximum(sum(gives.values()), 1.0))
    fair = {number: min(1.0, len(query) / len(place)) ** 0.5 for number, place in places.items()}
    return {number: float(weights @ of_place / weights.sum() * fair[number]) for number, of_place in gives.items()}


def check_stored(index, places):
    """The index holds these places, in their order. Queries tell whether words, frequencies and norms are right."""
    assert len(index) == len(places)
    np.testing.assert_array_equal(index.all_descriptors(), np.concatenate([EMPTY, *places.values()]))
    for number, place in places.items():
        np.testing.assert_array_equal(index.descriptors(number), place)
    used = np.concatenate([[0], *walks(index, places).values()])
    assert index.postings.entries.sizes.sum() == len(used) - 1


@EVERY
@BOTH
@pytest.mark.parametrize(("seed", "count"), [(0, 5), (1, 40), (2, 90)])
def test_queries_find_what_comparing_with_every_place_finds(strategy, scoring, seed, count):
    index, places = filled(strategy, scoring, seed, count, beam=64, leaf_capacity=300)  # the beam sees all words
    for query in (*list(places.values())[::10], *random_places(np.random.default_rng(seed), 3)):
        expected = (
            words_oracle(index, places, query) if scoring is Scoring.WORDS else matches_oracle(places, query, NEAR_BITS)
        )
        found = index.query(query, top_k=1000)
        assert dict(found) == pytest.approx({k: s for k, s in expected.items() if s > 1e-12}, abs=1e-9)
        assert [score for _, score in found] == sorted((score for _, score in found), reverse=True)
        for top_k in (1, 3, 20):
            assert index.query(query, top_k) == found[:top_k]


@EVERY
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**16), steps=st.lists(st.sampled_from("aaaf"), max_size=80), equal=st.booleans())
def test_any_order_of_adding_and_forgetting_leaves_what_a_fresh_description_gives(strategy, seed, steps, equal):
    rng = np.random.default_rng(seed)
    pool = random_places(rng, 12 if equal else len(steps))
    index, places = PlaceIndex[int](config(strategy, Scoring.WORDS), rng), {}
    for number, step in enumerate(steps):
        if step == "a":
            places[number] = pool[number % len(pool)]
            index.add(number, places[number])
        elif places:
            index.forget(gone := list(places)[rng.integers(len(places))])
            del places[gone]
    check_stored(index, places)
    for gone in list(places)[: len(places) * 3 // 4]:
        index.forget(gone)
        del places[gone]
    check_stored(index, places)
    if index.trained_on and places:
        query = next(iter(places.values()))
        expected = {number: score for number, score in words_oracle(index, places, query).items() if score > 1e-12}
        assert dict(index.query(query, 1000)) == pytest.approx(expected, abs=1e-9)


@EVERY
@BOTH
def test_a_stored_place_is_found_first_and_wholly_like_itself(strategy, scoring):
    index, places = filled(strategy, scoring, beam=1)
    assert index.query(places[17], top_k=1) == [(17, pytest.approx(1.0))]
    assert all(0.0 < similarity <= 1.0 + 1e-9 for _, similarity in index.query(places[17], top_k=1000))


@EVERY
def test_of_equals_the_one_stored_first_comes_first(strategy):
    index, places = filled(strategy)
    for twin in (200, 100):
        index.add(twin, places[9])
    assert [stored for stored, _ in index.query(places[9], top_k=3)] == [9, 200, 100]


@EVERY
@BOTH
def test_excluded_places_make_room_for_the_next(strategy, scoring):
    index, places = filled(strategy, scoring)
    everything = index.query(places[3], top_k=1000)
    excluded = {stored for stored, _ in everything[:30:2]}
    expected = [found for found in everything if found[0] not in excluded]
    assert index.query(places[3], top_k=5, exclude=excluded) == expected[:5]
    result = index.compare(places[3])
    assert [result.similarity_of(place) for place in places] == [dict(everything).get(place, 0.0) for place in places]


@EVERY
def test_before_the_first_training_nothing_is_found(strategy):
    index, places = filled(strategy, count=4)
    assert index.query(places[0], 5) == []
    assert (index.word_count, index.version, index.trained_on, len(index)) == (0, 0, None, 4)
    index.add(4, places[0])
    assert index.query(places[1], 1)[0][0] == 1
    assert index.word_count > 1
    assert index.trained_on == 5


@EVERY
@BOTH
@pytest.mark.parametrize(
    "codes", [EMPTY, np.zeros((1, 32), np.uint8), np.zeros((200, 32), np.uint8)], ids=["none", "one", "equal"]
)
def test_poor_places_are_stored_and_harm_nothing(strategy, scoring, codes):
    index, places = filled(strategy, scoring, count=20)
    for number in range(100, 140):
        places[number] = codes
        index.add(number, codes)
    check_stored(index, places)
    assert len(index) == 60
    own = index.query(codes, top_k=100)
    if len(codes) and index.word_count > 1:
        assert {stored for stored, similarity in own if similarity > 1.0 - 1e-9} == set(range(100, 140))
    else:  # rebuilt on such places alone there is one word, which tells nothing
        assert own == [] or scoring is Scoring.MATCHES
    for number in range(100, 140):
        index.forget(number)
        del places[number]
    check_stored(index, places)


@BOTH
def test_ten_thousand_identical_places_are_one_to_any_query(scoring):
    place = random_places(np.random.default_rng(3), 1)[0][:5]
    index = PlaceIndex[int](config(Strategy.INCREMENTAL, scoring), np.random.default_rng(0))
    for number in range(10_000):
        index.add(number, place)
    assert len(index) == 10_000
    assert index.word_count == len(np.unique(place, axis=0))  # equal descriptors are one word, however many
    found = index.query(place, top_k=5)
    expected = [(number, 1.0) for number in range(5)] if scoring is Scoring.MATCHES else []  # idf 0 tells nothing
    assert [(stored, round(similarity, 9)) for stored, similarity in found] == expected
    if scoring is Scoring.MATCHES:
        other = random_places(np.random.default_rng(4), 1)[0]
        index.add(10_000, other)
        assert index.query(place, top_k=1)[0][0] == 0
        assert [(stored, round(similarity, 9)) for stored, similarity in index.query(other, top_k=1)] == [(10_000, 1.0)]


@EVERY
@pytest.mark.parametrize("tree", [TreeConfig(branching=2, depth=1), TreeConfig(branching=64, depth=8)])
def test_extreme_trees_and_a_window_smaller_than_the_first_batch(strategy, tree):
    index, places = filled(strategy, tree=tree, train_batch=9, capacity=1)
    assert index.query(places[30], 1)[0][0] == 30
    check_stored(index, places)


def test_a_place_is_stored_once_and_a_refused_one_not_at_all():
    index, places = filled(Strategy.INCREMENTAL)
    with pytest.raises(ValueError, match="place 3 is in the index already"):
        index.add(3, places[3])
    with pytest.raises(ValueError, match="expected codes"):
        index.add(99, np.zeros((3, 8), np.uint8))
    with pytest.raises(KeyError):
        index.forget(99)
    check_stored(index, places)


@pytest.mark.parametrize(
    ("strategy", "trainings"),
    [
        (Strategy.REBUILD, [(0, 0)] * 4 + [(5, 1), (6, 2), (6, 3), (6, 4), (6, 5)]),
        (Strategy.WINDOWED, [(0, 0)] * 4 + [(5, 1)] * 5 + [(6, 2)] * 3),
    ],
)
def test_a_vocabulary_is_trained_on_the_last_C_places(strategy, trainings):
    """Algorithm 1 at every place after the first L; windowed as often as places come that were enough before."""
    index = PlaceIndex[int](config(strategy, capacity=6), np.random.default_rng(9))
    found = []
    for number, place in enumerate(random_places(np.random.default_rng(6), len(trainings))):
        index.add(number, place)
        found.append((index.trained_on or 0, index.version))
    assert found == trainings


def test_the_window_is_the_last_C_places():
    """Places before it have no influence on the words."""
    places = random_places(np.random.default_rng(7), 20)
    words = []
    for start in (0, 8):
        index = PlaceIndex[int](config(Strategy.REBUILD, train_batch=18 - start, capacity=6), np.random.default_rng(1))
        for number in range(start, 20):
            index.add(number, places[number])
        words.append([index.bag(place).words.tolist() for place in places])
    assert words[0] == words[1]


def test_an_incremental_vocabulary_of_other_places_follows_those_that_arrive():
    foreign, own = random_places(np.random.default_rng(4), 10), random_places(np.random.default_rng(5), 60)
    index = PlaceIndex[int](config(Strategy.INCREMENTAL), np.random.default_rng(0))
    index.train(foreign)
    before = index.word_count
    for number, place in enumerate(own):
        index.add(number, place)
    assert index.word_count > before
    assert index.trained_on == 10
    check_stored(index, dict(enumerate(own)))


def test_words_stay_under_their_capacity_and_all_others_stay_as_they_are():
    rng = np.random.default_rng(8)
    index, places = filled(Strategy.INCREMENTAL, seed=8)
    before = {number: walk(index, place) for number, place in places.items()}
    largest = int(index.vocabulary.words.max())
    sizes = index.postings.entries.sizes
    assert sizes.max() <= 16
    index.add(1000, new := random_places(rng, 1)[0])
    touched = set(walk(index, new))
    for number, words in before.items():
        now = walk(index, places[number])
        fresh = now[now != words]
        assert (fresh > largest).all()  # numbers are never given twice
    assert touched


def test_forgetting_gives_words_and_memory_back():
    index, places = filled(Strategy.INCREMENTAL, count=60)
    words, blocks, vertices = index.word_count, len(index.postings.entries.blocks), len(index.vocabulary.words)
    assert words > 60
    for number in range(59):
        index.forget(number)
    assert index.word_count < words / 3
    for turn in range(1, 20):
        for number, place in list(places.items())[:59]:
            index.add(1000 * turn + number, place)
        for number in range(59):
            index.forget(1000 * turn + number)
    assert len(index.postings.entries.blocks) <= 2 * blocks
    assert len(index.vocabulary.words) <= 2 * vertices
    assert len(index.postings.entries.leaves) <= 4 * sum(map(len, places.values()))
