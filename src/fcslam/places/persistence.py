"""A place index as a file: uncompressed ``.npz`` without pickled objects.

The file holds the tree, the places and their descriptors; the postings are computed from them. It also holds the word
numbers, the seed and the data of the last training, so a loaded index behaves exactly like the saved one.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.config import parse
from fcslam.errors import InputError, OutputError
from fcslam.features.codes import CODE_WORDS, code_words
from fcslam.places.index import IndexState, PlaceIndex
from fcslam.places.query_result import PlaceId
from fcslam.places.vocabulary import Training, TreeState, VocabularyConfig
from fcslam.records import Codes
from fcslam.storage.files import replacing
from fcslam.storage.state_file import State
from fcslam.untrusted import read_arrays

FORMAT = "fcslam place index 1"

_SHAPES: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
    "centres": (np.dtype("<u8"), (CODE_WORDS,)),
    "child_count": (np.dtype("<i4"), ()),
    "words": (np.dtype("<i8"), ()),
    "codes": (np.dtype("<u8"), (CODE_WORDS,)),
    "counts": (np.dtype("<i4"), ()),
    "leaves": (np.dtype("<i4"), ()),
    "about": (np.dtype("u1"), ()),
}


def save_index(index: PlaceIndex[Any], path: Path) -> None:
    """Write an index atomically. Identifiers of places must be JSON values: text, numbers or tuples.

    Raises:
        OutputError: the file cannot be written.
    """
    state = index.state()
    tree = state.tree
    about = {
        "format": FORMAT,
        "config": state.config.model_dump(mode="json"),
        "descriptor_version": state.descriptor_version,
        "training": asdict(state.training) if state.training else None,
        "places_seen": state.places_seen,
        "seed": tree.seed,
        "version": tree.version,
        "words_given": tree.words_given,
        "ids": state.ids,
    }
    arrays: dict[str, NDArray[Any]] = {
        "centres": tree.centres, "child_count": tree.child_count, "words": tree.words, "codes": state.codes,
        "counts": state.counts, "leaves": state.leaves, "about": np.frombuffer(json.dumps(about).encode(), np.uint8),
    }  # fmt: skip
    portable = {name: np.asarray(array, _SHAPES[name][0]) for name, array in arrays.items()}
    try:
        with replacing(path) as unfinished, unfinished.open("wb") as file:
            np.savez(file, allow_pickle=False, **portable)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error}); make room or choose another place") from error


def index_state(index: PlaceIndex[Any]) -> State:
    """The state of an index without what the stored places hold, for ``restored_index``."""
    state = index.state()
    return {
        "size": len(state.ids),
        "training": asdict(state.training) if state.training else None,
        "places_seen": state.places_seen,
        "seed": state.tree.seed,
        "version": state.tree.version,
        "words_given": state.tree.words_given,
        "centres": state.tree.centres,
        "child_count": state.tree.child_count,
        "words": state.tree.words,
        "leaves": state.leaves,
        "norms": state.norms,
    }


def restored_index(
    config: VocabularyConfig, state: State, ids: Sequence[PlaceId], descriptors: Sequence[Codes]
) -> PlaceIndex[PlaceId]:
    """The index of a state: it behaves exactly like the original.

    Args:
        config: that of the original.
        state: from ``index_state``.
        ids: the stored places, in the order in which they were added.
        descriptors: of each place, shape (N, 32).
    """
    training = Training(**state["training"]) if state["training"] else None
    tree = TreeState(
        state["seed"], state["version"], state["words_given"], state["centres"], state["child_count"], state["words"]
    )
    codes = np.concatenate([np.empty((0, CODE_WORDS), np.uint64), *map(code_words, descriptors)])
    counts = np.array([len(each) for each in descriptors], np.int32)
    return PlaceIndex.restored(
        IndexState(
            config, "", training, state["places_seen"], tree, ids, counts, codes, state["leaves"], state["norms"]
        )
    )


def load_index(path: Path, place_id: Callable[[Any], PlaceId], descriptor_version: str = "") -> PlaceIndex[PlaceId]:
    """Read an index.

    Args:
        path: the file.
        place_id: converts a JSON value (text, number or list) to an identifier.
        descriptor_version: version that the descriptors must have; empty accepts any.

    Raises:
        InputError: the file cannot be read, is damaged, or holds descriptors of another version.
    """
    try:
        archive = read_arrays(path)
        arrays = {name: archive[name] for name in _SHAPES}
        about = json.loads(arrays.pop("about").tobytes())
        state = _state(arrays, about, place_id)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, InputError) as error:
        raise InputError(f"{path}: not a readable place index ({_one_line(error)}); build it again") from error
    if descriptor_version not in ("", state.descriptor_version):
        raise InputError(
            f"{path}: descriptors of {state.descriptor_version or 'an unnamed detector'} cannot be compared with those "
            f"of {descriptor_version}; build the index again"
        )
    return PlaceIndex.restored(state)


def _state(
    arrays: dict[str, NDArray[Any]], about: dict[str, Any], place_id: Callable[[Any], PlaceId]
) -> IndexState[PlaceId]:
    """Check the content of a file, because compiled code does not check indices.

    Raises:
        ValueError, KeyError, TypeError, InputError: the content is inconsistent.
    """
    if about["format"] != FORMAT:
        raise ValueError(f"its format is {about['format']!r}, not {FORMAT!r}")
    for name, array in arrays.items():
        dtype, row = _SHAPES[name]
        if array.dtype != dtype or array.ndim == 0 or array.shape[1:] != row:
            raise ValueError(f"{name} are {array.shape} {array.dtype}")
    child_count, words, counts, leaves = (arrays[name] for name in ("child_count", "words", "counts", "leaves"))
    vertices = len(child_count)
    after = 1 + np.cumsum(child_count)
    is_tree = vertices and child_count.min() >= 0 and after[-1] == vertices and (after > np.arange(vertices)).all()
    if not is_tree or not len(arrays["centres"]) == len(words) == vertices:
        raise ValueError("the tree is inconsistent")
    ids = [place_id(value) for value in about["ids"]]
    if len(ids) != len(set(ids)) or len(ids) != len(counts) or (counts < 0).any():
        raise ValueError("places and their sizes do not agree")
    if not len(leaves) == len(arrays["codes"]) == counts.sum(dtype=np.int64):
        raise ValueError("places and descriptors do not agree")
    if len(leaves) and (leaves.min() < 0 or leaves.max() >= vertices or child_count[leaves].any()):
        raise ValueError("a descriptor has no word")
    numbers = [int(about[name]) for name in ("seed", "version", "words_given", "places_seen")]
    if min(numbers) < 0 or words.max() >= numbers[2] or ((words >= 0) != (child_count == 0)).any():
        raise ValueError("word numbers are inconsistent")
    tree = TreeState(numbers[0], numbers[1], numbers[2], arrays["centres"], child_count, words)
    training = Training(**about["training"]) if about["training"] is not None else None
    config = parse(VocabularyConfig, about["config"], "config")
    version = str(about["descriptor_version"])
    return IndexState(config, version, training, numbers[3], tree, ids, counts, arrays["codes"], leaves)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
