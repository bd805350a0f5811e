"""True closures agree, false ones do not, aliases agree with one another; cliques against brute force."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2
from fcslam.graph.cluster import count_separate_places, dominant_cluster, maximum_clique, relative_frame
from fcslam.graph.consistency import (
    Closures,
    count_supporting_closures,
    loop_chi2,
    pairwise_consistency,
)
from fcslam.graph.evidence import ConsistencySettings, MapFit
from fcslam.graph.trajectory import DRIFT, Trajectory, build_trajectory
from fcslam.records import Reason, ReasonCode
from tests.graph.graph_worlds import INFORMATION, manhattan, measured, walk

SETTINGS = ConsistencySettings()
ROBOT_DRIFT = np.array([0.03, 0.03, 0.01])
"""Drift of the robots here after one metre: more than ``DRIFT``, as the covariance of their odometry says."""


def path_of(poses: np.ndarray, own: np.ndarray | float = 0.0) -> Trajectory:
    """The trajectory of a robot that drifts by ``ROBOT_DRIFT``, and by ``own`` at each step, shape (N - 1, 3, 3)."""
    metres = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return build_trajectory(
        poses, metres[:, None, None] * np.diag(ROBOT_DRIFT**2 - np.square(SE2.sigmas(*DRIFT))) + own
    )


STILL = path_of(np.zeros((1, 3)))
T_A_B = np.array([4.0, -7.0, 2.2])


def drifted(generator: np.random.Generator, truth: np.ndarray) -> np.ndarray:
    """The trajectory as a robot that drifts by ``ROBOT_DRIFT`` has it."""
    poses = [np.zeros(3)]
    for step in se2.relative(truth):
        metres = np.hypot(*step[:2])
        sigma = np.sqrt(metres) * ROBOT_DRIFT
        poses.append(se2.compose(poses[-1], se2.compose(step, sigma * generator.normal(size=3))))
    return np.array(poses)


def two_robots(seed: int, true: int = 20, false: int = 30, aliases: int = 0) -> tuple[Trajectory, Trajectory, Closures]:
    """Trajectories of two robots in one town and closures between them: true, random, and a shifted alias group."""
    generator = np.random.default_rng(seed)
    truth_a, truth_b = walk(seed, 120), walk(seed + 100, 120)
    shift = np.array([6.0, 3.0, 0.0])
    rows = []
    for _ in range(true):
        i, j = generator.integers(0, 121, 2)
        rows.append((i, j, measured(generator, se2.between(truth_a[i], truth_b[j]))))
    for _ in range(false):
        i, j = generator.integers(0, 121, 2)
        rows.append((i, j, np.append(generator.normal(0.0, 1.0, 2), generator.uniform(-np.pi, np.pi))))
    for _ in range(aliases):
        i, j = generator.integers(0, 121, 2)
        rows.append((i, j, measured(generator, se2.between(truth_a[i], se2.compose(shift, truth_b[j])))))
    closures = Closures(
        i=np.array([row[0] for row in rows], dtype=np.int64),
        j=np.array([row[1] for row in rows], dtype=np.int64),
        T_i_j=np.array([row[2] for row in rows]).reshape(-1, 3),
        information=np.tile(INFORMATION, (len(rows), 1, 1)),
    )
    return *(path_of(drifted(generator, truth)) for truth in (truth_a, truth_b)), closures


def pairwise_chi2(a: Trajectory, b: Trajectory, closures: Closures) -> np.ndarray:
    """Of all loops, (K, K), symmetric."""
    k, m = np.triu_indices(len(closures), 1)
    chi2 = np.zeros((len(closures), len(closures)))
    chi2[k, m] = loop_chi2(a, b, closures, k, m)
    return chi2 + chi2.T


def verdict_of(seed: int, **counts: int):
    a, b, closures = two_robots(seed, **counts)
    consistent = pairwise_consistency(a, b, closures)
    return dominant_cluster(consistent, a.poses[closures.i, :2], np.ones(len(closures.i), dtype=bool), SETTINGS)


@pytest.mark.parametrize("seed", range(4))
def test_the_cluster_is_the_true_closures(seed: int) -> None:
    verdict = verdict_of(seed, true=20, false=40)
    members = set(verdict.members)
    assert len(members & set(range(20))) >= 16
    assert len(members - set(range(20))) <= 1
    assert verdict.dominant
    assert len(verdict.members) > 4 * verdict.evidence.rival_closures


def test_an_alias_group_of_like_size_forbids_a_verdict() -> None:
    verdict = verdict_of(0, true=12, false=10, aliases=12)
    assert not verdict.dominant
    assert verdict.shortfall is not None
    assert verdict.shortfall.code is ReasonCode.NO_LEAD
    assert {0 if k < 12 else 2 if k >= 22 else 1 for k in verdict.members} in ({0}, {2}, {0, 1}, {1, 2})
    assert verdict.evidence.rival_closures >= 10


GOOD, BAD = MapFit(500.0, 400.0, -np.inf, 300.0), MapFit(-100.0, 400.0, 500.0, 300.0)


def test_where_the_maps_refute_the_largest_cluster_they_may_confirm_the_one_that_contradicts_it() -> None:
    """Most closures of a building that repeats itself are aliases: here 16 of 28."""
    a, b, closures = two_robots(0, true=12, false=0, aliases=16)
    consistent, places = pairwise_consistency(a, b, closures), a.poses[closures.i, :2]

    def decide(examine):
        return dominant_cluster(consistent, places, np.ones(len(closures.i), dtype=bool), SETTINGS, examine)

    found = decide(lambda rows, _: GOOD if rows.max() < 12 else BAD)
    assert found.dominant
    assert set(found.members) <= set(range(12))
    assert found.evidence.fit.support == GOOD.support
    refuted = decide(lambda *_: BAD)
    assert not refuted.dominant
    assert refuted.contested


def test_clusters_that_the_maps_refute_outnumber_no_other() -> None:
    sizes = 12, 9, 7, 6, 5, 4
    group = np.repeat(np.arange(len(sizes)), sizes)
    consistent = group[:, None] == group
    places = np.array([(4.0 * k, 0.0) for k in range(len(group))])
    places[group == 5] = places[-1]

    def decide(right: int, fit: MapFit):
        informative = np.ones(len(group), dtype=bool)
        return dominant_cluster(
            consistent, places, informative, SETTINGS, lambda rows, _: fit if (group[rows] == right).all() else BAD
        )

    found = decide(5, GOOD)
    assert found.dominant
    assert set(found.members) == set(np.flatnonzero(group == 5))
    alike = replace(GOOD, rival_support=0.9 * GOOD.support)
    assert not decide(5, alike).dominant


def test_noise_alone_gives_no_verdict() -> None:
    for seed in range(3):
        assert not verdict_of(seed, true=0, false=40).dominant
    assert not verdict_of(0, true=0, false=0).dominant
    assert verdict_of(0, true=1, false=0).members == (0,)


def test_chi2_of_true_pairs_has_the_distribution_it_claims() -> None:
    values = []
    for seed in range(6):
        a, b, closures = two_robots(seed, true=25, false=0)
        values.append(pairwise_chi2(a, b, closures)[np.triu_indices(25, 1)])
    sample = np.concatenate(values)
    assert 0.95 < np.mean(sample < 11.345) <= 1.0
    assert 1.8 < np.mean(sample) < 4.2


def test_drift_is_that_of_simulated_trajectories() -> None:
    truth = walk(3, 60)
    ends = np.array([5, 55])
    exact = Closures(ends, np.zeros(2, dtype=np.int64), se2.inverse(truth[ends]), np.tile(np.eye(3) * 1e10, (2, 1, 1)))
    generator = np.random.default_rng(0)
    chi2 = [pairwise_chi2(path_of(drifted(generator, truth)), STILL, exact)[0, 1] for _ in range(300)]
    assert np.mean(chi2) == pytest.approx(3.0, abs=0.5)


def test_consistency_ignores_the_frames_and_the_order() -> None:
    a, b, closures = two_robots(2)
    here = pairwise_chi2(a, b, closures)
    moved = [path_of(se2.compose(T, x.poses)) for T, x in ((T_A_B, a), ((1.0, 90.0, -3.0), b))]
    there = pairwise_chi2(*moved, closures)
    assert there == pytest.approx(here, rel=1e-5, abs=1e-6)
    assert np.array_equal(here, here.T)
    assert (np.diag(here) == 0.0).all()
    order = np.random.default_rng(0).permutation(len(closures.i))
    shuffled = Closures(closures.i[order], closures.j[order], closures.T_i_j[order], closures.information[order])
    limit = 11.345
    forward, backward = here[np.ix_(order, order)] < limit, pairwise_chi2(a, b, shuffled) < limit
    assert np.mean(forward != backward) < 0.01


@pytest.mark.parametrize(("shift", "agrees"), [((0.3, 0.0, 0.0), True), ((0.0, 0.3, 0.0), False)])
@pytest.mark.parametrize("turned", ["closures", "path"])
def test_covariance_is_in_the_frame_of_j_and_turns_with_the_path(turned, shift, agrees) -> None:
    """Two closures that differ by 0.3 m along j's x, where the covariance is wide, agree; along y they do not."""
    wide, tight = np.linalg.inv(np.diag([0.25, 1e-4, 1e-6])), np.linalg.inv(np.diag([1e-4, 1e-4, 1e-6]))
    still, quarter = np.zeros(3), np.array([0.0, 0.0, np.pi / 2])
    if turned == "closures":
        path, j, first, information = STILL, [0, 0], quarter, (wide, wide)
    else:
        path, j, first, information = path_of(np.stack((still, quarter))), [0, 1], still, (tight, wide)
    T = np.stack((first, se2.compose(quarter, shift)))
    closures = Closures(np.array([0, 0]), np.array(j), T, np.stack(information))
    assert bool(pairwise_consistency(STILL, path, closures)[0, 1]) is agrees


def test_as_many_closures_from_fewer_places_lead_nothing() -> None:
    agree = np.zeros((9, 9), dtype=bool)
    agree[:6, :6] = agree[6:, 6:] = True
    ones = np.ones(9, dtype=bool)
    many = np.array([(3.5 * k, 0.0) for k in range(9)])
    few = many.copy()
    few[3:6] = few[2]
    assert dominant_cluster(agree, many, ones, SETTINGS).dominant
    assert dominant_cluster(agree, few, ones, SETTINGS).dominant
    few[2:6] = few[1]
    assert not dominant_cluster(agree, few, ones, SETTINGS.model_copy(update={"minimum_closures": 2})).dominant


def test_supporters_are_places_that_lie_apart_and_one_must_inform() -> None:
    agree = np.ones((6, 6), dtype=bool)
    near = np.array([(0.1 * k, 0.0) for k in range(6)])
    far = np.array([(3.5 * k, 0.0) for k in range(6)])
    informative = np.array([False, True, False, False, False, False])
    assert dominant_cluster(agree, far, informative, SETTINGS).dominant
    one_place = dominant_cluster(agree, near, informative, SETTINGS)
    assert (one_place.evidence.separate_places, one_place.dominant) == (1, False)
    assert one_place.shortfall == Reason(ReasonCode.FEW_PLACES, 1, 3, "minimum_evidence")
    corridor = dominant_cluster(agree, far, np.zeros(6, dtype=bool), SETTINGS)
    assert corridor.shortfall == Reason(ReasonCode.NOT_INFORMATIVE, 6)


def test_places_apart_are_counted_at_their_best() -> None:
    """Taken in the order of the robot's way, the middle place would spoil both ends."""
    line = np.array([[(x, 0.0), (x, 5.0)] for x in (2.0, 0.0, 4.0)])
    assert count_separate_places(line, 3.0) == 2
    same_on_one_side = line.copy()
    same_on_one_side[:, 1] = 0.0
    assert count_separate_places(same_on_one_side, 3.0) == 1
    assert count_separate_places(line[:0], 3.0) == 0


def test_a_keyscan_out_of_range_is_refused() -> None:
    a, b, closures = two_robots(0)
    short = [path_of(x.poses[:50]) for x in (a, b)]
    for cut_a, cut_b, name in ((short[0], b, "a"), (a, short[1], "b")):
        with pytest.raises(ValueError, match=f"trajectory {name} has keyscans 0 to 49"):
            pairwise_consistency(cut_a, cut_b, closures)


def test_every_pair_is_tested() -> None:
    a, b, closures = two_robots(0)
    whole = pairwise_consistency(a, b, closures)
    assert np.array_equal(whole, pairwise_chi2(a, b, closures) <= SE2.chi2_limit)
    none = closures.select(np.zeros(0, dtype=np.int64))
    assert pairwise_consistency(a, b, none).shape == (0, 0)


def test_a_closure_says_the_same_from_both_ends() -> None:
    """Written from the other end, closures agree with the same others and make the same errors."""
    a, b, closures = two_robots(3)
    there = closures.reversed(np.ones(len(closures), dtype=bool))
    assert pairwise_chi2(b, a, there)[0] == pytest.approx(pairwise_chi2(a, b, closures)[0], rel=0.2, abs=1.0)
    off = 1e-4 * np.array([1.0, -2.0, 3.0])
    for k in range(len(closures)):
        T = se2.compose(closures.T_i_j[k], se2.exp(off))
        error = se2.log(se2.between(there.T_i_j[k], se2.inverse(T)))
        assert error @ there.information[k] @ error == pytest.approx(off @ closures.information[k] @ off, rel=1e-5)
    back = there.reversed(np.ones(len(closures), dtype=bool))
    assert np.allclose(back.T_i_j, closures.T_i_j)
    assert np.allclose(back.information, closures.information)
    assert np.array_equal(back.i, closures.i)


def test_a_steps_own_covariance_counts_with_the_drift() -> None:
    """Two closures 1 m apart that differ by 0.3 m agree where the odometry between them is that uncertain."""
    poses = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    tight = np.tile(np.eye(3) * 1e6, (2, 1, 1))
    closures = Closures(np.array([0, 1]), np.array([0, 0]), np.array([(0, 0, 0), (-1.3, 0, 0)], dtype=float), tight)
    for variance, agrees in ((0.04, True), (1e-6, False)):
        path = path_of(poses, variance * np.eye(3)[None])
        assert bool(pairwise_consistency(path, STILL, closures)[0, 1]) is agrees


def test_drift_does_not_depend_on_where_the_frame_lies() -> None:
    """Map coordinates may be those of a country: levers of a million metres would eat the digits."""
    truth = walk(0, 80)
    here = path_of(truth)
    there = path_of(se2.compose((4.5e5, 5.2e6, 1.0), truth))
    ends = np.array([3, 70]), np.array([60, 10])
    assert there.drift(*ends) == pytest.approx(here.drift(*ends), rel=1e-6)


def test_false_closures_have_no_witness_and_true_ones_mostly_do() -> None:
    graph, _, true = manhattan(4, steps=300, closures=120, outlier_share=0.4)
    edges = graph.arrays()
    rows = edges.robust
    closures = Closures(edges.i[rows], edges.j[rows], edges.T_i_j[rows], edges.information[rows])
    path = path_of(graph.poses(), np.linalg.inv(edges.information[~rows]))
    counts = count_supporting_closures(path, path, closures)
    assert np.mean(counts[true[rows]] > 0) > 0.7
    assert np.mean(counts[~true[rows]] > 0) < 0.05
    other_end = closures.reversed(np.arange(len(closures)) % 2 == 0)
    again = count_supporting_closures(path, path, other_end)
    assert np.array_equal(again, counts), "it does not matter which end is told first"


@pytest.mark.parametrize("density", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("seed", range(5))
def test_clique_is_the_largest_of_brute_force(seed: int, density: float) -> None:
    upper = np.triu(np.random.default_rng(seed).random((11, 11)) < density, 1)
    adjacent = upper | upper.T
    largest = max(
        size
        for size in range(1, 12)
        for group in combinations(range(11), size)
        if adjacent[np.ix_(group, group)].sum() == size * (size - 1)
    )
    members, exact = maximum_clique(adjacent)
    assert exact
    assert len(members) == largest
    assert adjacent[np.ix_(members, members)].sum() == largest * (largest - 1)


@pytest.mark.slow
def test_a_planted_clique_among_hundreds() -> None:
    generator = np.random.default_rng(0)
    upper = np.triu(generator.random((400, 400)) < 0.1, 1)
    adjacent = upper | upper.T
    planted = np.sort(generator.choice(400, 60, replace=False))
    adjacent[np.ix_(planted, planted)] = True
    assert set(planted) <= set(maximum_clique(adjacent)[0])
    assert maximum_clique(np.ones((1500, 1500), dtype=bool))[0] == list(range(1500))


def test_the_node_budget_ends_a_hard_search_with_a_clique() -> None:
    upper = np.triu(np.random.default_rng(0).random((200, 200)) < 0.9, 1)
    adjacent = upper | upper.T
    members, exact = maximum_clique(adjacent, node_budget=100)
    assert not exact
    assert len(members) >= 20
    assert adjacent[np.ix_(members, members)].sum() == len(members) * (len(members) - 1)


def test_clique_of_nothing_and_of_no_edges() -> None:
    assert maximum_clique(np.zeros((0, 0), dtype=bool)) == ([], True)
    assert len(maximum_clique(np.zeros((3, 3), dtype=bool))[0]) == 1
    with pytest.raises(ValueError, match="symmetric"):
        maximum_clique(np.triu(np.ones((3, 3), dtype=bool)))


@pytest.mark.parametrize("still", ["a", "b"])
def test_places_that_are_one_place_to_one_robot_give_no_direction(still):
    """As a robot claims that another one is where it is: the first closure alone gives the frame."""
    moved = path_of(walk(3, 20))
    ends = np.array([0, len(moved) - 1])
    i, j = (np.zeros_like(ends), ends) if still == "a" else (ends, np.zeros_like(ends))
    a, b = (STILL, moved) if still == "a" else (moved, STILL)
    closures = Closures(i, j, np.zeros((2, 3)), np.tile(INFORMATION, (2, 1, 1)))
    T_a_b = se2.between(se2.inverse(a.poses[i[0]]), se2.inverse(b.poses[j[0]]))
    assert relative_frame(a, b, closures) == pytest.approx(T_a_b)


def test_a_search_for_transforms_elsewhere_may_decide_only_where_the_maps_would_be_enough() -> None:
    a, b, closures = two_robots(0, true=12, false=0, aliases=0)
    consistent, informative = pairwise_consistency(a, b, closures), np.ones(12, dtype=bool)
    one_place = np.zeros((12, 2))
    asked = []

    def decide(fit: MapFit):
        return dominant_cluster(
            consistent, one_place, informative, SETTINGS, lambda _, may_decide: asked.append(may_decide(fit)) or fit
        )

    assert decide(GOOD).dominant
    assert not decide(replace(GOOD, support=25.0, expected=20.0)).dominant
    assert asked == [True, False]
