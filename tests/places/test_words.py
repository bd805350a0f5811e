"""Shared vocabularies: words stand for centres, the version is the content, and a file is not trusted."""

import hashlib
import io

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.features.codes import hamming_matrix
from fcslam.places.words import WordVocabulary, read_vocabularies, train_words, write_vocabularies
from fcslam.records import Channel


def clusters(count=12, members=30, seed=0):
    """Codes around ``count`` centres, a few bits apart."""
    rng = np.random.default_rng(seed)
    bits = np.repeat(rng.integers(0, 2, (count, 256), np.uint8), members, axis=0)
    bits ^= (rng.random(bits.shape) < 0.01).astype(np.uint8)
    return np.packbits(bits, axis=1)


@pytest.fixture
def vocabulary():
    return train_words(Channel.LIDAR, "test-1", clusters(), 16, seed=0)


def test_a_word_is_the_nearest_centre(vocabulary):
    codes = clusters(seed=0)
    distances = hamming_matrix(codes, vocabulary.centres)
    assert np.array_equal(vocabulary.words(codes), distances.argmin(axis=1))


def test_codes_of_one_cluster_share_few_words_and_those_of_others_none(vocabulary):
    words = vocabulary.words(clusters()).reshape(12, 30)
    sets = [set(row.tolist()) for row in words]
    assert all(not a & b for k, a in enumerate(sets) for b in sets[:k])


def test_the_centre_of_a_word_has_this_word(vocabulary):
    every = np.arange(len(vocabulary.centres), dtype=np.uint16)
    assert np.array_equal(vocabulary.words(vocabulary.descriptors(every)), every)


def test_a_word_beyond_the_vocabulary_is_refused(vocabulary):
    with pytest.raises(ValueError, match="of a vocabulary of"):
        vocabulary.descriptors(np.array([len(vocabulary.centres)], np.uint16))


@pytest.mark.parametrize("most", [2, 5, 16, 4096])
def test_there_are_at_most_as_many_words_as_asked_for(most):
    assert 1 <= len(train_words(Channel.LIDAR, "test-1", clusters(), most, seed=0).centres) <= most


def test_training_depends_on_the_codes_and_the_seed_alone(vocabulary):
    again = train_words(Channel.LIDAR, "test-1", clusters(), 16, seed=0)
    assert again.digest == vocabulary.digest


def test_the_version_is_the_digest_of_the_content(vocabulary):
    content = b"words 1\nlidar\ntest-1\n" + vocabulary.centres.tobytes()
    assert vocabulary.digest == hashlib.sha256(content).digest()
    others = [
        WordVocabulary(Channel.CAMERA, "test-1", vocabulary.centres),
        WordVocabulary(Channel.LIDAR, "test-2", vocabulary.centres),
        WordVocabulary(Channel.LIDAR, "test-1", vocabulary.centres[1:]),
    ]
    assert len({vocabulary.digest, *(other.digest for other in others)}) == 4


def test_a_file_gives_the_same_vocabularies(vocabulary, tmp_path):
    camera = train_words(Channel.CAMERA, "cnn-1", clusters(seed=1), 8, seed=0)
    write_vocabularies([vocabulary, camera], tmp_path / "a.words")
    assert [v.digest for v in read_vocabularies(tmp_path / "a.words")] == [vocabulary.digest, camera.digest]
    write_vocabularies([vocabulary, camera], tmp_path / "b.words")
    assert (tmp_path / "a.words").read_bytes() == (tmp_path / "b.words").read_bytes()


def archive(**arrays):
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


VERSION = np.frombuffer(b"test-1", np.uint8)
CENTRES = np.arange(96, dtype=np.uint8).reshape(3, 32)
DAMAGED = {
    "nothing": b"",
    "no archive": b"words",
    "no words": archive(other=CENTRES),
    "no version": archive(**{"lidar.centres": CENTRES}),
    "codes of another size": archive(**{"lidar.centres": CENTRES.reshape(6, 16), "lidar.version": VERSION}),
    "floats": archive(**{"lidar.centres": CENTRES.astype(float), "lidar.version": VERSION}),
    "no centre": archive(**{"lidar.centres": CENTRES[:0], "lidar.version": VERSION}),
    "one centre twice": archive(**{"lidar.centres": CENTRES[[0, 1, 0]], "lidar.version": VERSION}),
    "a name that is none": archive(**{"lidar.centres": CENTRES, "lidar.version": np.frombuffer(b"../x y", np.uint8)}),
    "objects": archive(**{"lidar.centres": np.array([{}], object), "lidar.version": VERSION}),
    "too large": archive(**{"lidar.centres": np.zeros((200_000, 32), np.uint8), "lidar.version": VERSION}),
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_file_is_one_line(content, tmp_path):
    (tmp_path / "x.words").write_bytes(content)
    with pytest.raises(InputError, match="not a readable vocabulary"):
        read_vocabularies(tmp_path / "x.words")
