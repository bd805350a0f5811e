"""A file gives back the index that was written, and goes on as it would have; anything else is refused in one line."""

import json
from contextlib import suppress

import numpy as np
import pytest

from fcslam.errors import InputError, OutputError
from fcslam.places.index import PlaceIndex
from fcslam.places.persistence import load_index, save_index
from fcslam.places.vocabulary import Scoring, Strategy, TreeConfig, VocabularyConfig
from fcslam.records import KeyscanId

COUNT = 40


def places(seed=0):
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (30, 32), dtype=np.uint8)
    flips = np.packbits(rng.random((2 * COUNT, 40, 256)) < 0.03, axis=2)
    return list(centres[rng.integers(0, 30, (2 * COUNT, 40))] ^ flips)


def filled(strategy=Strategy.INCREMENTAL, scoring=Scoring.WORDS):
    config = VocabularyConfig(
        strategy=strategy, scoring=scoring, train_batch=4, leaf_capacity=16, rebuild_every=7,
        tree=TreeConfig(branching=4, smallest_split=8),
    )  # fmt: skip
    index = PlaceIndex[KeyscanId](config, np.random.default_rng(2), "orb-1")
    for number, place in enumerate(places()[:COUNT]):
        index.add(KeyscanId("a", number), place)
    for number in range(0, 30, 2):
        index.forget(KeyscanId("a", number))
    return index


def identity(value):
    return KeyscanId(*value)


@pytest.fixture
def path(tmp_path):
    save_index(filled(), tmp_path / "index.npz")
    return tmp_path / "index.npz"


@pytest.mark.slow
@pytest.mark.parametrize("strategy", list(Strategy))
@pytest.mark.parametrize("scoring", list(Scoring))
def test_what_was_read_goes_on_as_what_was_written(strategy, scoring, tmp_path):
    index = filled(strategy, scoring)
    save_index(index, tmp_path / "index")
    other = load_index(tmp_path / "index", identity, "orb-1")
    for step, place in enumerate(places()[COUNT:]):
        assert (len(other), other.word_count, other.version) == (len(index), index.word_count, index.version)
        assert other.training == index.training
        found, expected = other.query(place, 100), index.query(place, 100)
        assert [f.similarity for f in found] == pytest.approx([f.similarity for f in expected], abs=1e-9)
        assert dict(found) == pytest.approx(dict(expected), abs=1e-9)
        assert other.bag(place).words.tolist() == index.bag(place).words.tolist()
        for each in (index, other):
            each.add(KeyscanId("b", step), place)
            if step % 3 == 0:
                each.forget(KeyscanId("b", step // 2))


def test_an_index_that_was_never_trained(tmp_path):
    empty = PlaceIndex[int](VocabularyConfig(), np.random.default_rng(0))
    save_index(empty, tmp_path / "index")
    assert len(load_index(tmp_path / "index", int)) == 0


def test_descriptors_of_another_detector_are_refused(path):
    assert len(load_index(path, identity)) == COUNT - 15
    with pytest.raises(InputError, match="orb-1 cannot be compared with those of orb-2"):
        load_index(path, identity, "orb-2")


def refused(path):
    with pytest.raises(InputError) as caught:
        load_index(path, identity)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_damaged(path):
    whole = path.read_bytes()
    refused(path.with_name("missing"))
    rng = np.random.default_rng(0)
    for content in (b"", b"nothing", whole[: len(whole) // 2], whole[:-30]):
        path.write_bytes(content)
        refused(path)
    for place in rng.integers(0, len(whole) - 3000, 40):  # checksums; the zip's own directory at the end apart
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :])
        with suppress(InputError):
            assert len(load_index(path, identity)) == COUNT - 15  # what zip does not read need not be right


def altered(path, **changes):
    with np.load(path) as archive:
        arrays = dict(archive)
    about = json.loads(arrays["about"].tobytes())
    for name, change in changes.items():
        if name in about:
            about[name] = change(about[name])
        else:
            arrays[name] = change(arrays[name])
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(path.with_suffix(".changed.npz"), **arrays)
    return path.with_suffix(".changed.npz")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("leaves", lambda a: a + np.int32(100000)),
        ("leaves", lambda a: np.where(a == a.max(), np.int32(0), a)),
        ("leaves", lambda a: a[1:]),
        ("leaves", lambda a: a.astype(np.float32)),
        ("child_count", lambda a: np.roll(a, 1)),
        ("child_count", lambda a: -a),
        ("child_count", lambda a: a[:0]),
        ("centres", lambda a: a[1:]),
        ("centres", lambda a: a[:, :3]),
        ("words", lambda a: a[::-1]),
        ("words", lambda a: a + 10**9),
        ("codes", lambda a: a[1:]),
        ("codes", lambda _: np.array(["text"])),
        ("counts", lambda a: -a),
        ("counts", lambda a: a[1:]),
        ("ids", lambda ids: ids[1:] + ids[-1:]),
        ("ids", lambda ids: [1] * len(ids)),
        ("ids", lambda _: {}),
        ("format", lambda _: "fcslam place index 0"),
        ("config", lambda c: {**c, "strategy": "psychic"}),
        ("training", lambda _: {"places": 1}),
        ("version", lambda _: "many"),
        ("seed", lambda _: -1),
    ],
)  # fmt: skip
def test_files_that_do_not_hold_together(path, name, change):
    refused(altered(path, **{name: change}))
    assert len(load_index(altered(path), identity)) == COUNT - 15


def test_nothing_that_could_run_is_read(path):
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{**arrays, "codes": np.array([print], object)})
    refused(path)


def test_a_place_that_cannot_be_written(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        save_index(filled(), tmp_path / "missing" / "index.npz")
