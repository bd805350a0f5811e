"""The relations metric: laws, an independent oracle in homogeneous matrices, and hostile files."""

import gzip
import lzma
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.metrics.relations import (
    PoseTable,
    Relations,
    Spread,
    read_relations,
    relation_errors,
    select,
)


def random_poses(rng, count):
    return np.column_stack((rng.uniform(-20.0, 20.0, (count, 2)), rng.uniform(-np.pi, np.pi, count)))


def matrix(pose):
    x, y, theta = pose
    return np.array([[np.cos(theta), -np.sin(theta), x], [np.sin(theta), np.cos(theta), y], [0.0, 0.0, 1.0]])


def exact_relations(stamps, poses, pairs):
    first, second = np.asarray(pairs).T
    return Relations(np.column_stack((stamps[first], stamps[second])), se2.between(poses[first], poses[second]))


@pytest.fixture
def walk():
    rng = np.random.default_rng(1)
    stamps = 1.1e9 + np.arange(50) * 1.7
    return stamps, random_poses(rng, 50), rng.integers(0, 50, (200, 2))


@given(st.integers(0, 10_000))
def test_error_does_not_depend_on_the_choice_of_the_map_frame(seed):
    rng = np.random.default_rng(seed)
    stamps, reference, estimate = np.arange(12.0), random_poses(rng, 12), random_poses(rng, 12)
    relations = exact_relations(stamps, reference, rng.integers(0, 12, (30, 2)))
    moved = se2.compose(random_poses(rng, 1)[0], estimate)
    here, there = (relation_errors(relations, PoseTable.of(stamps, poses)) for poses in (estimate, moved))
    np.testing.assert_allclose(here.translation_m, there.translation_m, atol=1e-9)
    np.testing.assert_allclose(np.sin(np.radians(here.rotation_deg)), np.sin(np.radians(there.rotation_deg)), atol=1e-9)


def test_agrees_with_homogeneous_matrices(walk):
    stamps, poses, pairs = walk
    estimate = random_poses(np.random.default_rng(2), 50)
    relations = exact_relations(stamps, poses, pairs)
    errors = relation_errors(relations, PoseTable.of(stamps, estimate))
    translations, rotations = [], []
    for (i, j), relation in zip(pairs, relations.T_1_2, strict=True):
        motion = np.linalg.inv(matrix(estimate[i])) @ matrix(estimate[j])
        error = np.linalg.inv(matrix(relation)) @ motion
        translations.append(np.linalg.norm(error[:2, 2]))
        rotations.append(np.degrees(np.arccos(np.clip(error[0, 0], -1.0, 1.0))))
    np.testing.assert_allclose(errors.translation_m, translations, atol=1e-9)
    np.testing.assert_allclose(errors.rotation_deg, rotations, atol=1e-4)
    assert errors.translation == Spread(*(f(errors.translation_m) for f in (np.mean, np.std, np.max)))


def test_stamps_that_run_backwards_are_looked_up_exactly(walk):
    stamps, poses, pairs = walk
    shuffled = np.random.default_rng(3).permutation(50)
    errors = relation_errors(exact_relations(stamps, poses, pairs), PoseTable.of(stamps[shuffled], poses[shuffled]))
    assert errors.used == 200
    assert errors.translation.maximum < 1e-9


def test_stamps_printed_with_five_digits_are_found_and_neighbours_are_not_taken():
    table = PoseTable.of([1134864645.903214, 1134864646.324196, 1134864646.324206], np.zeros((3, 3)))
    assert table.find([1134864645.90321, 1134864646.32420]).tolist() == [0, 1]
    assert table.find([1134864645.9032, 1134864646.3243, 0.0, 2e9]).tolist() == [-1, -1, -1, -1]


def test_a_stamp_that_two_robots_share_is_not_guessed():
    table = PoseTable.of([1.0, 2.0, 2.0], np.zeros((3, 3)), robots=[0, 0, 1])
    assert table.find([1.0, 2.0]).tolist() == [0, -1]


def test_selection_across_robots_gap_and_unusable_count():
    stamps = np.array([0.0, 10.0, 30.0, 60.0, 100.0])
    table = PoseTable.of(stamps, np.zeros((5, 3)), robots=[0, 0, 1, 1, 2], maps=[0, 0, 0, 0, 1])
    pairs = np.array([[0, 10], [10, 30], [0, 30], [60, 0], [60, 100], [0, 999], [100, 999]], dtype=float)
    relations = Relations(pairs, np.zeros((7, 3)))
    assert len(select(relations, table)) == 7
    assert len(select(relations, table, minimum_gap_s=20.0)) == 5
    across = select(relations, table, minimum_gap_s=20.0, across_robots=True)
    assert across.stamps.tolist() == [[0, 30], [60, 0], [60, 100], [0, 999], [100, 999]]
    errors = relation_errors(across, table)
    assert (errors.used, errors.total) == (2, 5)


def test_robots_in_separate_maps_leave_nothing_usable_and_no_number():
    table = PoseTable.of([0.0, 50.0], np.zeros((2, 3)), robots=[0, 1], maps=[0, 1])
    errors = relation_errors(Relations(np.array([[0.0, 50.0]]), np.zeros((1, 3))), table)
    assert (errors.used, errors.total) == (0, 1)
    assert np.isnan(errors.translation.mean)
    assert np.isnan(errors.rotation.std)


@pytest.mark.parametrize("stamps", [[1.0, 2.0], []])
def test_relations_of_another_recording_are_refused(stamps):
    relations = Relations(np.array([[500.0, 600.0]]), np.zeros((1, 3)))
    with pytest.raises(InputError, match="same recording"):
        relation_errors(relations, PoseTable.of(stamps, np.zeros((len(stamps), 3))))


TEXT = "# comment\n\n1.000001 2.5 0.5 -0.25 9 9 9 1.5\n3 4 1 2 0 0 0 -1\n"


@pytest.mark.parametrize(("name", "encode"), [("r", bytes), ("r.gz", gzip.compress), ("r.xz", lzma.compress)])
def test_reads_plain_and_compressed_files(tmp_path, name, encode):
    path = tmp_path / name
    path.write_bytes(encode(TEXT.encode()))
    relations = read_relations(path)
    assert relations.stamps.tolist() == [[1.000001, 2.5], [3.0, 4.0]]
    assert relations.T_1_2.tolist() == [[0.5, -0.25, 1.5], [1.0, 2.0, -1.0]]
    assert not relations.stamps.flags.writeable


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"1 2 3 4 5 6 7 8\n1 2 3\n", "line 2: expected 8 numbers"),
        (b"1 2 3 4 5 6 7 x\n", "line 1: could not convert"),
        (b"1 2 nan 4 5 6 7 8\n", "line 1: a number that is not finite"),
        (b"# nothing\n", "no relations in it"),
        (b"", "no relations in it"),
        (b"\xff\xfe\x00\x01", "cannot read"),
    ],
)
def test_hostile_files_are_refused_with_file_and_line(tmp_path, content, message):
    path = tmp_path / "bad.relations"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_relations(path)
    assert "bad.relations" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["cut.gz", "cut.xz", "missing", "missing.gz"])
def test_broken_compression_and_missing_files_are_refused(tmp_path, name):
    encode = {".gz": gzip.compress, ".xz": lzma.compress}.get(Path(name).suffix)
    if name.startswith("cut"):
        (tmp_path / name).write_bytes(encode(TEXT.encode() * 100)[:-20])
    with pytest.raises(InputError, match="cannot read the relations"):
        read_relations(tmp_path / name)


def flaser_odometry(path):
    """Stamp and logged robot pose of every FLASER line, independent of the project's own reader."""
    with lzma.open(path, "rt") as lines:
        rows = [line.split() for line in lines if line.startswith("FLASER")]
    return np.array([[float(row[i]) for i in (-3, -6, -5, -4)] for row in rows])


@pytest.mark.system
@pytest.mark.skipif("FCSLAM_DATA" not in os.environ, reason="FCSLAM_DATA is not set")
@pytest.mark.parametrize(
    ("log", "count", "metres", "degrees"),
    [
        ("intel", 2984, (7.37, 14.3), (39, 54)),
        ("fr079", 1685, (6.50, 13.7), (30, 46)),
        ("mit-csail", 1172, (1.68, 5.3), (5.1, 8.2)),
    ],
)
def test_raw_odometry_has_the_error_that_others_measured(log, count, metres, degrees):
    folder = Path(os.environ["FCSLAM_DATA"]) / "lidar" / "slam-benchmark"
    rows = flaser_odometry(folder / f"{log}.clf.xz")
    errors = relation_errors(read_relations(folder / f"{log}.relations.gz"), PoseTable.of(rows[:, 0], rows[:, 1:]))
    assert errors.used == errors.total == count
    assert (errors.translation.mean, errors.translation.std) == pytest.approx(metres, rel=0.01)
    assert (errors.rotation.mean, errors.rotation.std) == pytest.approx(degrees, rel=0.02)
