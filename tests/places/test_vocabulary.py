import numpy as np
import pytest

from fcslam.places.vocabulary import (
    DynamicVocabulary,
    DynamicVocabularyConfig,
    VocabularyConfig,
    train,
)

SMALL = VocabularyConfig(branching=4, depth=3, smallest_split=8)


def clustered_codes(rng, count, centres=None):
    """Codes at most a few bits from one of 16 centres."""
    if centres is None:
        centres = rng.integers(0, 256, (16, 32), dtype=np.uint8)
    codes = centres[rng.integers(0, len(centres), count)]
    flips = np.packbits(rng.random((count, 256)) < 0.03, axis=1)
    return codes ^ flips


def places_of(rng, count, size=60):
    centres = rng.integers(0, 256, (16, 32), dtype=np.uint8)
    return [clustered_codes(rng, size, centres) for _ in range(count)]


def words_oracle(vocabulary, codes):
    """Walk the tree in plain Python."""
    tree = vocabulary.tree
    centres = tree.centres.view(np.uint8).reshape(-1, 32)
    words = []
    for code in codes:
        vertex = 0
        while tree.child_count[vertex]:
            children = np.arange(tree.first_child[vertex], tree.first_child[vertex] + tree.child_count[vertex])
            vertex = children[np.bitwise_count(centres[children] ^ code).sum(axis=1, dtype=int).argmin()]
        words.append(tree.leaf_number[vertex])
    return np.array(words)


def test_words_are_those_of_a_walk_down_the_tree():
    rng = np.random.default_rng(0)
    vocabulary = train(places_of(rng, 10), SMALL, rng)
    fresh = clustered_codes(rng, 200)
    np.testing.assert_array_equal(vocabulary.words(fresh), words_oracle(vocabulary, fresh))
    assert vocabulary.word_count > 16


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not():
    places = places_of(np.random.default_rng(1), 10)
    first, second, other = (train(places, SMALL, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert [array.tobytes() for array in first.tree] == [array.tobytes() for array in second.tree]
    assert first.idf.tobytes() == second.idf.tobytes()
    assert first.tree.centres.tobytes() != other.tree.centres.tobytes()


def test_words_do_not_depend_on_what_else_is_asked():
    rng = np.random.default_rng(2)
    vocabulary = train(places_of(rng, 8), SMALL, rng)
    codes = clustered_codes(rng, 50)
    together = vocabulary.words(codes)
    np.testing.assert_array_equal(together, [vocabulary.words(code[None])[0] for code in codes])
    np.testing.assert_array_equal(together, vocabulary.words(codes))


def test_clear_clusters_become_words_and_centres_are_bit_majorities():
    rng = np.random.default_rng(3)
    centres = rng.integers(0, 256, (4, 32), dtype=np.uint8)
    codes = np.concatenate([clustered_codes(rng, 101, centre[None]) for centre in centres])
    vocabulary = train([codes], VocabularyConfig(branching=4, depth=1, smallest_split=2, iterations=20), rng)
    words = vocabulary.words(codes)
    assert all(len(set(words[101 * k : 101 * (k + 1)])) == 1 for k in range(4))
    for word in range(vocabulary.word_count):
        bits = np.unpackbits(codes[words == word], axis=1)
        majority = np.packbits((2 * bits.sum(axis=0) > len(bits)).astype(np.uint8))
        centre = vocabulary.tree.centres[vocabulary.tree.leaf_number == word].view(np.uint8)
        np.testing.assert_array_equal(np.unpackbits(centre), np.unpackbits(majority))


def test_limits_of_the_shape_hold():
    rng = np.random.default_rng(4)
    codes = rng.integers(0, 256, (500, 32), dtype=np.uint8)
    for depth in (1, 2, 3):
        vocabulary = train([codes], VocabularyConfig(branching=3, depth=depth, smallest_split=10), rng)
        assert vocabulary.word_count <= 3**depth
    coarse = train([codes], VocabularyConfig(branching=3, smallest_split=501), rng)
    assert coarse.word_count == 1


def test_idf_counts_the_places_that_have_a_word():
    rng = np.random.default_rng(5)
    places = places_of(rng, 12)
    vocabulary = train(places, SMALL, rng)
    documents = np.zeros(vocabulary.word_count)
    for place in places:
        documents[list(set(words_oracle(vocabulary, place)))] += 1
    np.testing.assert_allclose(vocabulary.idf, np.log(12 / np.maximum(documents, 1)))


@pytest.mark.parametrize("places", [[], [np.empty((0, 32), np.uint8)], [np.zeros((300, 32), np.uint8)]])
def test_nothing_to_tell_apart_gives_one_word(places):
    vocabulary = train(places, SMALL, np.random.default_rng(0))
    assert vocabulary.word_count == 1
    assert vocabulary.words(np.full((3, 32), 255, np.uint8)).tolist() == [0, 0, 0]
    assert vocabulary.words(np.empty((0, 32), np.uint8)).shape == (0,)


def test_malformed_descriptors_are_refused():
    with pytest.raises(ValueError, match="expected codes"):
        train([np.zeros((4, 32), np.uint8)], SMALL, np.random.default_rng(0)).words(np.zeros((4, 16), np.uint8))


def dynamic(rebuild_every, train_batch=3, capacity=5, seed=9):
    config = DynamicVocabularyConfig(
        train_batch=train_batch, capacity=capacity, rebuild_every=rebuild_every, tree=SMALL
    )
    return DynamicVocabulary(config, np.random.default_rng(seed))


def test_algorithm_1_rebuilds_at_every_place_after_the_first_L():
    places = places_of(np.random.default_rng(6), 9)
    vocabulary = dynamic(rebuild_every=1)
    assert [vocabulary.add(place) for place in places] == [i > 3 for i in range(9)]


def test_algorithm_1_trains_on_the_window_of_C_places():
    places = places_of(np.random.default_rng(7), 9)
    vocabulary = dynamic(rebuild_every=1)
    rng = np.random.default_rng(9)
    for i, place in enumerate(places):
        vocabulary.add(place)
        if i <= 3:
            assert vocabulary.vocabulary is None
            continue
        D = places[: i + 1] if i < 5 else places[i - 5 + 1 : i + 1]
        expected = train(D, SMALL, rng, version=i - 3)
        assert vocabulary.vocabulary is not None
        assert vocabulary.vocabulary.version == expected.version
        assert vocabulary.vocabulary.tree.centres.tobytes() == expected.tree.centres.tobytes()


def test_periodic_rebuilding_keeps_the_vocabulary_in_between():
    places = places_of(np.random.default_rng(8), 14)
    vocabulary = dynamic(rebuild_every=4)
    trained, versions = [], []
    for i, place in enumerate(places):
        if vocabulary.add(place):
            trained.append(i)
        versions.append(vocabulary.vocabulary.version if vocabulary.vocabulary else 0)
    assert trained == [4, 8, 12]
    assert versions == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 2
