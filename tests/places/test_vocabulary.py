"""The tree: growing, walking down, splitting and merging."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.config import parse
from fcslam.errors import InputError
from fcslam.features.codes import code_words
from fcslam.places.kmeans_tree import TreeShape, _majorities, bare_root, find_leaves, grow_tree, near_leaves
from fcslam.places.vocabulary import Vocabulary, VocabularyConfig

SMALL = TreeShape(branching=4, depth=3, smallest_split=8, iterations=8)


def clustered_codes(rng, count, centres=None):
    """Codes at most a few bits from one of 16 centres."""
    if centres is None:
        centres = rng.integers(0, 256, (16, 32), dtype=np.uint8)
    codes = centres[rng.integers(0, len(centres), count)]
    return trained_on(codes ^ np.packbits(rng.random((count, 256)) < 0.03, axis=1))


def trained_on(codes):
    """Codes as an index trains on them. Of a read-only array the same code would be compiled once more."""
    return code_words(codes).copy()


def distances(code, centres):
    return np.bitwise_count(centres ^ code).sum(axis=1, dtype=int)


def walk(tree, code):
    vertex = 0
    while tree.child_count[vertex]:
        children = np.arange(tree.first_child[vertex], tree.first_child[vertex] + tree.child_count[vertex])
        vertex = children[distances(code, tree.centres[children]).argmin()]
    return vertex


def beam_oracle(tree, code, beam):
    """Level by level the nearest ``beam`` vertices, the one on the walk always among them and first."""
    kept = [0]
    on_the_way = 0
    while any(tree.child_count[v] for v in kept):
        if tree.child_count[on_the_way]:
            children = np.arange(*(tree.first_child[on_the_way] + np.array([0, tree.child_count[on_the_way]])))
            on_the_way = children[distances(code, tree.centres[children]).argmin()]
        candidates = []
        for v in kept:
            below = range(tree.first_child[v], tree.first_child[v] + tree.child_count[v])
            candidates += list(below) or [v]
        others = [v for v in candidates if v != on_the_way]
        others.sort(key=lambda v: int(distances(code, tree.centres[[v]])[0]))
        kept = [on_the_way, *others[: beam - 1]]
    return kept


@pytest.mark.parametrize("beam", [1, 2, 5, 64])
def test_leaves_are_those_of_a_walk_and_near_ones_of_a_search_by_levels(beam):
    rng = np.random.default_rng(1)
    tree = grow_tree(clustered_codes(rng, 600), SMALL, np.uint64(1))
    assert (tree.child_count == 0).sum() > 16
    for code in clustered_codes(rng, 200 // beam):
        assert find_leaves(tree, code[None])[0] == walk(tree, code)
        found = [leaf for leaf in near_leaves(tree, code[None], beam)[0].tolist() if leaf >= 0]
        expected = beam_oracle(tree, code, beam)
        assert found[0] == walk(tree, code)
        assert len(set(found)) == len(found)
        # Of equally near ones any may be kept.
        assert [distances(code, tree.centres[[v]])[0] for v in found] == [
            distances(code, tree.centres[[v]])[0] for v in expected
        ]


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not():
    codes = clustered_codes(np.random.default_rng(1), 600)
    first, second, other = (grow_tree(codes, SMALL, np.uint64(seed)) for seed in (5, 5, 6))
    assert [array.tobytes() for array in first] == [array.tobytes() for array in second]
    assert first.centres.tobytes() != other.centres.tobytes()


def test_clear_clusters_become_words_and_centres_are_bit_majorities():
    rng = np.random.default_rng(3)
    centres = rng.integers(0, 256, (4, 32), dtype=np.uint8)
    codes = np.concatenate([clustered_codes(rng, 101, centre[None]) for centre in centres])
    tree = grow_tree(codes, TreeShape(branching=4, depth=1, smallest_split=2, iterations=20), np.uint64(0))
    leaves = find_leaves(tree, codes)
    assert all(len(set(leaves[101 * k : 101 * (k + 1)])) == 1 for k in range(4))
    for leaf in set(leaves.tolist()):
        bits = np.unpackbits(codes[leaves == leaf].view(np.uint8), axis=1)
        majority = (2 * bits.sum(axis=0) > len(bits)).astype(np.uint8)
        np.testing.assert_array_equal(np.unpackbits(tree.centres[leaf].view(np.uint8)), majority)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**16), count=st.integers(1, 90), clusters=st.integers(1, 5))
def test_majorities_of_bits_are_those_of_counting_them(seed, count, clusters):
    rng = np.random.default_rng(seed)
    bits = rng.random((count, 256)) < rng.random(256)
    labels = rng.integers(0, clusters, count)
    found = _majorities(trained_on(np.packbits(bits, axis=1)), labels, clusters)
    expected = [2 * bits[labels == label].sum(axis=0) > (labels == label).sum() for label in range(clusters)]
    np.testing.assert_array_equal(np.unpackbits(found.view(np.uint8), axis=1), expected)


def test_limits_of_the_shape_hold():
    codes = trained_on(np.random.default_rng(4).integers(0, 256, (500, 32), dtype=np.uint8))
    for depth in (1, 2, 3):
        tree = grow_tree(codes, TreeShape(branching=3, depth=depth, smallest_split=10, iterations=8), np.uint64(0))
        assert 1 < (tree.child_count == 0).sum() <= 3**depth
    coarse = grow_tree(codes, TreeShape(branching=3, depth=3, smallest_split=501, iterations=8), np.uint64(0))
    assert len(coarse.centres) == 1


@pytest.mark.parametrize("count", [0, 1, 300])
def test_nothing_to_tell_apart_gives_one_word(count):
    tree = grow_tree(np.zeros((count, 4), np.uint64), SMALL, np.uint64(0))
    assert len(tree.centres) == len(bare_root().centres) == 1
    assert find_leaves(tree, np.full((3, 4), 7, np.uint64)).tolist() == [0, 0, 0]
    assert find_leaves(tree, np.empty((0, 4), np.uint64)).shape == (0,)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**16), choices=st.lists(st.booleans(), max_size=25))
def test_splits_and_merges_keep_a_tree_and_all_other_words(seed, choices):
    rng = np.random.default_rng(seed)
    codes = clustered_codes(rng, 300)
    vocabulary = Vocabulary(SMALL, seed)
    vocabulary.train(codes[:100])
    for splits in choices:
        before, given_so_far = vocabulary.words[vocabulary.leaves(codes)], int(vocabulary.words.max())
        leaves = np.unique(vocabulary.leaves(codes))
        if splits:
            leaf = int(rng.choice(leaves))
            own = vocabulary.leaves(codes) == leaf
            targets = vocabulary.split(leaf, codes[own])
            if targets is not None:
                np.testing.assert_array_equal(vocabulary.leaves(codes)[own], targets)
        else:
            parents = np.unique(vocabulary.parents[leaves])
            lowest = [
                v for v in parents.tolist() if v >= 0 and not vocabulary.tree.child_count[vocabulary.children(v)].any()
            ]
            if not lowest:
                continue
            parent = int(rng.choice(lowest))
            own = np.isin(vocabulary.parents[vocabulary.leaves(codes)], [parent])
            vocabulary.merge(parent)
            assert set(vocabulary.leaves(codes)[own].tolist()) <= {parent}
        after = vocabulary.words[vocabulary.leaves(codes)]
        np.testing.assert_array_equal(after[~own], before[~own])
        assert ((after[own] > given_so_far) | (after[own] == before[own])).all()
    tree, number_of = vocabulary.state()
    restored = Vocabulary.restored(SMALL, tree)
    np.testing.assert_array_equal(number_of[vocabulary.leaves(codes)], restored.leaves(codes))
    assert restored.word_count == vocabulary.word_count


@pytest.mark.parametrize(
    ("tree", "said"),
    [({"branching": 1}, "tree.branching: .*greater than or equal to 2"), ({"depth": 0}, "tree.depth: .*equal to 1")],
)
def test_a_tree_that_cannot_branch_is_refused_in_one_line(tree, said):
    with pytest.raises(InputError, match=f"^my.yaml: {said}.*$"):
        parse(VocabularyConfig, {"tree": tree}, "my.yaml")
