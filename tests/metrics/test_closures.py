"""Precision and recall of closures: laws, an oracle in homogeneous matrices, counts by hand."""

import numpy as np
import pytest
from evaluation.relation_closures import BRIDGE_S, PoseReference, RelationReference, closure_errors
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.geometry import se2
from fcslam.metrics.closures import (
    path_lengths,
    precision,
    revisits_found,
)
from fcslam.metrics.relations import PoseTable
from tests.metrics.test_relations import matrix

STEP_S, STEPS = 0.4, 60


def walk(rng, count):
    """A robot that moves and turns briskly, so that a gap bridged wrongly shows."""
    poses = [rng.uniform(-3.0, 3.0, 3)]
    for motion in np.column_stack(
        (rng.uniform(0.2, 0.5, count - 1), np.zeros(count - 1), rng.normal(0, 0.3, count - 1))
    ):
        poses.append(se2.compose(poses[-1], motion))
    return np.array(poses)


def fleet(seed, frames=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
    """Two robots one after the other: true poses (N, 3), and the run's table with each robot in its own frame."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([walk(rng, STEPS), walk(rng, STEPS)])
    robots = np.repeat([0, 1], STEPS)
    stamps = STEP_S * np.arange(2 * STEPS) + 100.0 * robots
    moved = np.concatenate([se2.compose(frame, truth[robots == k]) for k, frame in enumerate(frames)])
    return truth, PoseTable.of(stamps, moved, robots=robots, maps=robots)


def placed(run, truth, rows, components=None, frame=(0.0, 0.0, 0.0)):
    rows = np.asarray(rows)
    components = np.zeros(len(rows), dtype=np.int64) if components is None else np.asarray(components)
    return PoseReference(run, BRIDGE_S, rows, se2.compose(frame, truth[rows]), components)


frames = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), frames, frames, frames)
def test_true_closures_have_no_error_in_whatever_frames(seed, frame_1, frame_2, frame_reference):
    truth, run = fleet(seed, (frame_1, frame_2))
    rows = np.arange(0, 2 * STEPS, 3)
    pairs = np.random.default_rng(seed).integers(0, 2 * STEPS, (20, 2))
    T_i_j = se2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    single = RelationReference(
        run, BRIDGE_S, np.column_stack((rows[:-1], rows[1:])), se2.between(truth[rows[:-1]], truth[rows[1:]])
    )
    for reference in (placed(run, truth, rows, frame=frame_reference), single):
        errors = closure_errors(pairs, T_i_j, run, reference)
        assert errors.translation_m[errors.covered] == pytest.approx(0.0, abs=1e-9)
        assert errors.rotation_deg[errors.covered] == pytest.approx(0.0, abs=1e-6)
    assert closure_errors(pairs, T_i_j, run, placed(run, truth, rows)).covered.all()


def test_errors_agree_with_homogeneous_matrices():
    truth, run = fleet(3, ((4.0, 1.0, 0.5), (-2.0, 9.0, -2.0)))
    rng = np.random.default_rng(3)
    noisy = se2.compose(truth, se2.exp(rng.normal(0.0, 0.1, truth.shape)))
    rows = np.arange(1, 2 * STEPS, 3)
    pairs = np.column_stack((np.arange(0, STEPS - 2), np.arange(STEPS, 2 * STEPS - 2)))
    T_i_j = rng.normal(0.0, 2.0, (len(pairs), 3))
    errors = closure_errors(pairs, T_i_j, run, placed(run, noisy, rows))
    for k, (i, j) in enumerate(pairs):
        a, b = errors.ends[k]
        assert abs(a - i) == (0 if i % 3 == 1 else 1)  # the nearest in time
        T = [np.linalg.inv(matrix(run.T_map_base[i])) @ matrix(run.T_map_base[a])]
        T += [np.linalg.inv(matrix(noisy[a])) @ matrix(noisy[b])]
        T += [np.linalg.inv(matrix(run.T_map_base[b])) @ matrix(run.T_map_base[j])]
        error = np.linalg.inv(T[0] @ T[1] @ T[2]) @ matrix(T_i_j[k])
        assert errors.translation_m[k] == pytest.approx(np.hypot(error[0, 2], error[1, 2]))
        assert errors.rotation_deg[k] == pytest.approx(np.degrees(abs(np.arctan2(error[1, 0], error[0, 0]))))


@pytest.mark.parametrize(("gap", "covered"), [(0, True), (2, True), (3, False)])
def test_a_gap_is_bridged_up_to_one_second(gap, covered):
    truth, run = fleet(5)
    i, j = 20, 80
    T_i_j = se2.between(truth[[i]], truth[[j]])
    for reference in (
        placed(run, truth, [i - gap, j]),
        placed(run, truth, [i, j + gap]),
        RelationReference(run, 1.0, np.array([[i - gap, j]]), se2.between(truth[[i - gap]], truth[[j]])),
        RelationReference(run, 1.0, np.array([[j + gap, i]]), se2.between(truth[[j + gap]], truth[[i]])),
    ):
        errors = closure_errors(np.array([[i, j]]), T_i_j, run, reference)
        assert errors.covered.tolist() == [covered]
        assert errors.correct.tolist() == [covered]


def test_another_robots_stamp_or_another_component_covers_nothing():
    truth, run = fleet(6)
    closure, T_i_j = np.array([[20, 80]]), se2.between(truth[[20]], truth[[80]])
    assert not closure_errors(closure, T_i_j, run, placed(run, truth, [20, 80], [0, 1])).covered.any()
    assert closure_errors(closure, T_i_j, run, placed(run, truth, [19, 20, 80], [1, 0, 1])).ends.tolist() == [[19, 80]]
    other = PoseTable(run.stamps, run.T_map_base, np.where(np.arange(len(truth)) == 20, 7, run.robots), run.maps)
    assert not closure_errors(closure, T_i_j, other, placed(other, truth, [19, 80])).covered.any()
    single = RelationReference(other, 1.0, np.array([[19, 80]]), se2.between(truth[[19]], truth[[80]]))
    assert not closure_errors(closure, T_i_j, other, single).covered.any()
    unknown = closure_errors(np.array([[-1, 80]]), T_i_j, run, placed(run, truth, np.arange(len(truth))))
    assert not unknown.covered.any()


@pytest.mark.parametrize(
    ("off", "wrong"),
    [((0.45, 0, 0), 0), ((0.55, 0, 0), 1), ((0, -0.55, 0), 1), ((0, 0, 9), 0), ((0, 0, 11), 1), ((0, 0, -11), 1)],
)
def test_a_closure_that_is_off_is_found_wrong(off, wrong):
    truth, run = fleet(7)
    closures = np.array([[20, 80], [21, 81], [22, 83]])
    T_i_j = se2.between(truth[closures[:, 0]], truth[closures[:, 1]])
    T_i_j[1] = se2.compose(T_i_j[1], (off[0], off[1], np.radians(off[2])))
    errors = closure_errors(closures, T_i_j, run, placed(run, truth, np.arange(0, len(truth), 2)))
    everything = precision(errors, np.ones(3, dtype=bool))
    assert (everything.closures, everything.covered, everything.wrong) == (3, 3, wrong)
    assert everything.precision == pytest.approx(1.0 - wrong / 3.0)
    assert precision(errors, np.array([True, False, True])).wrong == 0
    assert everything.translation_m[1] == pytest.approx(np.hypot(off[0], off[1]), abs=1e-9)
    assert everything.rotation_deg[1] == pytest.approx(abs(off[2]), abs=1e-6)


def test_nothing_is_told_of_no_closures():
    truth, run = fleet(8)
    errors = closure_errors(np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), run, placed(run, truth, [0, 1]))
    nothing = precision(errors, np.zeros(0, dtype=bool))
    assert (nothing.closures, nothing.covered, nothing.wrong) == (0, 0, 0)
    assert np.isnan([nothing.precision, nothing.coverage, *nothing.translation_m, *nothing.rotation_deg]).all()


def test_revisits_by_hand():
    """Two robots drive along a line at 1 m a row; robot 1 starts a second count of its metres."""
    count = 40
    poses = np.column_stack((np.tile(np.arange(count), 2), np.zeros(2 * count), np.zeros(2 * count)))
    run = PoseTable.of(np.arange(2.0 * count), poses, robots=np.repeat([0, 1], count))
    np.testing.assert_allclose(path_lengths(run), np.tile(np.arange(count), 2))
    correct = np.array([[10, 50], [5, 30]])
    revisits = np.array(
        [[10, 50], [12, 48], [13, 50], [48, 9], [50, 90 - 78], [30, 5], [5, 10], [28, 8], [30, 70], [10, 11]]
    )
    expected = [True, True, False, True, True, True, False, False, False, False]
    assert revisits_found(np.array(revisits), correct, run).tolist() == expected
    assert not revisits_found(np.array(revisits), np.empty((0, 2), dtype=np.int64), run).any()
