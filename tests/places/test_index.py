import numpy as np
import pytest

from fcslam.places.index import InvertedIndex
from fcslam.places.similarity import similarity
from fcslam.places.vocabulary import VocabularyConfig, train

SMALL = VocabularyConfig(branching=4, depth=3, smallest_split=8)
EMPTY = np.empty((0, 32), np.uint8)


def random_places(rng, count):
    centres = rng.integers(0, 256, (40, 32), dtype=np.uint8)
    places = []
    for _ in range(count):
        own = centres[rng.choice(40, 6, replace=False)]
        codes = own[rng.integers(0, 6, rng.integers(5, 60))]
        places.append(codes ^ np.packbits(rng.random((len(codes), 256)) < 0.03, axis=1))
    return places


def filled_index(seed, count=60):
    rng = np.random.default_rng(seed)
    places = random_places(rng, count)
    index = InvertedIndex(train(places[:30], SMALL, rng))
    for number, place in enumerate(places):
        index.add(f"place {number}", place)
    return index, places


def query_oracle(vocabulary, places, descriptors):
    """Compare with every place."""
    query = vocabulary.bag(descriptors)
    scores = {f"place {number}": similarity(query, vocabulary.bag(place)) for number, place in enumerate(places)}
    return {place: score for place, score in scores.items() if score > 0.0}


@pytest.mark.parametrize(("seed", "count"), [(0, 31), (1, 60), (2, 60), (3, 900)])
def test_queries_find_what_brute_force_finds(seed, count):
    index, places = filled_index(seed, count)
    for descriptors in places[:: count // 6]:
        found = index.query(descriptors, top_k=1000)
        assert dict(found) == pytest.approx(query_oracle(index.vocabulary, places, descriptors), abs=1e-12)
        scores = [score for _, score in found]
        assert scores == sorted(scores, reverse=True)
        assert index.query(descriptors, top_k=3) == found[:3]


def test_of_equals_the_one_stored_first_comes_first():
    index, places = filled_index(4)
    for name in ("twin b", "twin a"):
        index.add(name, places[9])
    assert [found.id for found in index.query(places[9], top_k=3)] == ["place 9", "twin b", "twin a"]


def test_a_stored_place_is_found_first():
    index, places = filled_index(5)
    best = index.query(places[17], top_k=1)[0]
    assert best.id == "place 17"
    assert best.similarity == pytest.approx(1.0)


def test_excluded_places_make_room_for_the_next():
    index, places = filled_index(6)
    everything = index.query(places[3], top_k=1000)
    excluded = {everything[0].id, everything[2].id}
    found = index.query(places[3], top_k=3, exclude=excluded)
    assert found == [everything[1], everything[3], everything[4]]


def test_describing_again_equals_a_fresh_index():
    index, places = filled_index(7)
    other = train(places[30:], SMALL, np.random.default_rng(1), version=2)
    index.describe_again(other)
    fresh = InvertedIndex(other)
    for number, place in enumerate(places):
        fresh.add(f"place {number}", place)
    assert index.vocabulary.version == 2
    assert index.query(places[4], top_k=1000) == fresh.query(places[4], top_k=1000)


def test_places_without_descriptors_are_stored_but_never_found():
    index, places = filled_index(8)
    index.add("dark", EMPTY)
    assert len(index) == 61
    assert index.query(EMPTY, top_k=5) == []
    assert "dark" not in [found.id for found in index.query(places[0], top_k=1000)]


def test_an_empty_index_answers_nothing():
    _, places = filled_index(9)
    index = InvertedIndex[str](train(places, SMALL, np.random.default_rng(0)))
    assert index.query(places[0], top_k=5) == []


def test_a_place_is_stored_once_and_a_refused_one_not_at_all():
    index, places = filled_index(10)
    with pytest.raises(ValueError, match="place 3"):
        index.add("place 3", places[3])
    with pytest.raises(ValueError, match="expected codes"):
        index.add("broken", np.zeros((3, 8), np.uint8))
    assert len(index) == 60
