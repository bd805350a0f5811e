"""Vocabularies that robots and cloud share, so that a robot sends words in place of descriptors.

A word stands for its centre, the descriptor that most resembles those of its cluster. So the cloud reads a place of
words as one whose descriptors are centres. It retrieves and matches them as any others, and its own vocabulary
(Algorithm 1) grows on them.
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import InputError, writing
from fcslam.features.codes import code_words, nearest_codes
from fcslam.places.kmeans_tree import TreeShape, k_means
from fcslam.records import CODE_BYTES, NAME, PLACE_CHANNELS, Channel, Codes, frozen
from fcslam.storage.files import write_file
from fcslam.untrusted import Arrays, read_arrays

MOST_WORDS: Final = 65536
_ITERATIONS: Final = 8
_DIGITS: Final = 12


@dataclass(frozen=True, eq=False)
class WordVocabulary:
    """The words of one channel and detector version. It never changes, so it is known by its digest."""

    channel: Channel
    detector_version: str
    centres: Codes
    """Shape (W, 32): the centre of each word, all different."""

    @cached_property
    def digest(self) -> bytes:
        """Version: SHA-256 of channel, detector version and centres."""
        name = f"words 1\n{self.channel}\n{self.detector_version}\n".encode("ascii")
        return hashlib.sha256(name + self.centres.tobytes()).digest()

    def words(self, descriptors: Codes) -> NDArray[np.uint16]:
        """The word of each descriptor (N, 32), shape (N,): the nearest centre, of several the first."""
        return frozen(nearest_codes(descriptors, self.centres), np.uint16)

    def descriptors(self, words: NDArray[np.uint16]) -> Codes:
        """The centre of each word (N,), shape (N, 32).

        Raises:
            ValueError: a word is not of this vocabulary.
        """
        if len(words) and int(words.max()) >= len(self.centres):
            raise ValueError(f"word {int(words.max())} of a vocabulary of {len(self.centres)}")
        return frozen(self.centres[words], np.uint8)


def short(digest: bytes) -> str:
    """The beginning of a digest, for messages."""
    return digest.hex()[:_DIGITS]


def train_words(
    channel: Channel, detector_version: str, descriptors: Codes, most_words: int, seed: int
) -> WordVocabulary:
    """At most ``most_words`` words of these descriptors (N, 32), N > 0, by k-means.

    A robot and the cloud search all of them for each descriptor, which is exact, and fast enough for the words of a
    building. Only the cloud has the tree of Algorithm 1.
    """
    shape = TreeShape(most_words, 1, 2, _ITERATIONS)
    codes = code_words(descriptors).copy()  # of arrays that cannot be written, numba compiles a version of its own
    centres, _ = k_means(codes, shape, np.array([seed], np.uint64))
    distinct = np.unique(centres.view(np.uint8).reshape(-1, CODE_BYTES), axis=0)
    return WordVocabulary(channel, detector_version, frozen(distinct, np.uint8))


def write_vocabularies(vocabularies: Sequence[WordVocabulary], path: Path) -> None:
    """Write a file of vocabularies, at most one of each channel. Equal vocabularies give equal files."""
    _check_replaceable(path)
    arrays: dict[str, NDArray[np.uint8]] = {}
    for vocabulary in vocabularies:
        arrays[f"{vocabulary.channel}.centres"] = vocabulary.centres
        arrays[f"{vocabulary.channel}.version"] = np.frombuffer(vocabulary.detector_version.encode("ascii"), np.uint8)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    with writing(path, "make room or choose another place"):
        write_file(path, content.getvalue())


def _check_replaceable(path: Path) -> None:
    if not path.exists():
        return
    try:
        read_vocabularies(path)
    except InputError as error:
        raise InputError(f"{path}: exists and is not a vocabulary, so it stays; choose another name") from error


def read_vocabularies(path: Path) -> tuple[WordVocabulary, ...]:
    """Read a file of vocabularies."""
    try:
        archive = read_arrays(path)
        found = tuple(_read(archive, channel) for channel in PLACE_CHANNELS if f"{channel}.centres" in archive)
        if not found:
            raise ValueError("it holds no words")
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: not a readable vocabulary ({reason}); `fcslam tools vocabulary RUN -o FILE` writes one"
        ) from error
    return found


def _read(archive: Arrays, channel: Channel) -> WordVocabulary:
    centres, version = archive[f"{channel}.centres"], archive[f"{channel}.version"]
    if centres.dtype != np.uint8 or centres.ndim != 2 or centres.shape[1] != CODE_BYTES:
        raise ValueError(f"centres are {centres.shape} {centres.dtype}")
    if not 0 < len(centres) <= MOST_WORDS:
        raise ValueError(f"{len(centres)} words, not in 1..{MOST_WORDS}")
    if len(np.unique(centres, axis=0)) < len(centres):
        raise ValueError("two words are the same")
    if version.dtype != np.uint8 or version.ndim != 1:
        raise ValueError(f"the detector version is {version.shape} {version.dtype}")
    name = version.tobytes().decode("ascii")
    if not NAME.fullmatch(name):
        raise ValueError(f"{name[:64]!r} is not a detector version")
    return WordVocabulary(channel, name, frozen(centres, np.uint8))
