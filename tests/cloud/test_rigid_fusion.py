"""The paper's literal fusion: rigid maps on matched points, as good as these points and not a bit better."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from fcslam.cloud.closure_log import ClosureLog
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.rigid_fusion import fuse_rigidly
from fcslam.cloud.settings import FleetConfig, FusionStrategy
from fcslam.geometry import se2
from fcslam.places.matcher import PlaceMatch
from fcslam.records import Channel, ClosureStatus, ReasonCode, Veto
from tests import small_fleet
from tests.cloud.test_fleet import LATER, POSES, A, B, between, joint_error, two_robots
from tests.cloud.test_fleet import TRUE as MEETINGS
from tests.scripted import ALIAS, closures, verified
from tests.small_fleet import feed, map_of

RIGID = FusionStrategy.TWO_POINT


def ledger_of(*scripts, turned=()):
    """Verified matches in this order; ``turned`` ones are written from the other end."""
    ledger = ClosureLog()
    for number, line in enumerate(line for script in scripts for line in script):
        told = replace(line, i=line.j, j=line.i, T_i_j=se2.inverse(line.T_i_j)) if number in turned else line
        ledger.add(PlaceMatch.verified(told.i, told.j, Channel.LIDAR, 0.5, verified(told), predicted=False))
    return ledger


def own_maps(**moved):
    """Every robot drove POSES and sees it from a frame of its own."""
    return {robot: se2.compose(np.asarray(T, dtype=float), POSES) for robot, T in moved.items()}


# Real scans


@pytest.fixture(scope="module")
def results(packets):
    return {
        strategy: feed(Cloud(FleetConfig(fusion=strategy), seed=0), packets).finalize() for strategy in FusionStrategy
    }


def test_the_maps_of_each_joined_pair_are_compared():
    """Also of the pair whose join follows from two others."""
    robots = small_fleet.draw(3, 40.0).robots
    packets = small_fleet.in_order(packet for robot in robots for packet in small_fleet.sent_by(robot))
    joins = feed(Cloud(FleetConfig(), seed=0), packets).finalize().joins
    assert len(joins) == 3
    assert all(evidence.fit is not None and evidence.fit.compared_m > 10.0 for evidence in joins.values())
    seen_m = [evidence.fit.seen_m for evidence in joins.values()]
    assert max(seen_m) < 2.0 * min(seen_m)  # no wall is counted at two places


def test_clean_matches_put_every_robot_near_its_true_pose(results, drawn):
    """Rigid maps keep their drift, and a direction from two near points is a rough one: a decimetre over 30 m."""
    assert set(map_of(results[RIGID]).values()) == {0}
    truth = {robot.name: robot for robot in drawn.robots}
    first, *others = results[RIGID].robots
    T_first = small_fleet.truth_at(truth[first.robot], [k.stamp for k in first.keyscans])
    for other in others:
        T_other = small_fleet.truth_at(truth[other.robot], [k.stamp for k in other.keyscans])
        true, seen = se2.between(T_first[0], T_other), se2.between(first.T_map_base[0], other.T_map_base)
        assert np.hypot(*(seen - true)[:, :2].T).max() < 0.2


def test_robots_own_maps_stay_rigid(results):
    for robot, joint in zip(results[RIGID].robots, results[FusionStrategy.JOINT].robots, strict=True):
        assert robot.T_local_base.tobytes() == joint.T_local_base.tobytes()
        motions = [se2.between(poses[:-1], poses[1:]) for poses in (robot.T_map_base, robot.T_local_base)]
        assert np.allclose(*motions, atol=1e-9)


def test_the_graph_says_the_same_as_the_poses(results):
    result = results[RIGID]
    stacked = np.concatenate([robot.T_map_base for robot in result.robots])
    poses = result.graph.poses()
    assert np.array_equal(poses[np.lexsort(poses.T)], stacked[np.lexsort(stacked.T)])
    accepted = sum(c.status is ClosureStatus.ACCEPTED for c in result.closures)
    assert sum(edge.robust for edge in result.graph.edges) == accepted


# Evidence written by hand


@pytest.mark.slow
@pytest.mark.parametrize(("strategy", "off_m"), [("two_point", 3.0), ("joint", 0.0)])
def test_two_false_matches_that_fit_each_other_ruin_who_trusts_them(scripted, strategy, off_m):
    script = [*closures(A, B, MEETINGS[:2], shift=ALIAS), *closures(A, B, MEETINGS[2:])]
    result = feed(scripted(script, fusion=strategy), two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 0}
    assert joint_error(result) > off_m if off_m else joint_error(result) < 1e-3


@pytest.mark.slow
def test_two_matches_join_what_the_joint_graph_leaves_apart(scripted):
    """The paper asks for no third witness."""
    script = closures(A, B, MEETINGS[:2])
    assert map_of(feed(scripted(script), two_robots()).finalize()) == {"a": 0, "b": 1}
    assert map_of(feed(scripted(script, fusion=RIGID), two_robots()).finalize()) == {"a": 0, "b": 0}


def by_words(meetings):
    return [replace(line, similarity=0.5) for line in closures(A, B, meetings, shift=ALIAS)]


def test_words_alone_are_no_evidence_for_the_joint_graph(scripted):
    """The joint graph is that of the robots without their matches; a true script joins them."""
    result = feed(scripted(by_words(MEETINGS)), two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert not any(edge.robust for edge in result.graph.edges)
    assert map_of(feed(scripted(closures(A, B, MEETINGS)), two_robots()).finalize()) == {"a": 0, "b": 0}


@pytest.mark.parametrize("similarity", [None, 0.5])
def test_a_veto_takes_a_match_away(scripted, similarity):
    script = [replace(line, similarity=similarity) for line in closures(A, B, MEETINGS[:2])]
    cloud = scripted(script, fusion=RIGID)
    cloud.fleet.edit([Veto("a", "b", (8.0, LATER + 8.0))])
    result = feed(cloud, two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    (revoked,) = between(result, ClosureStatus.REVOKED)
    assert revoked.reason.code is ReasonCode.VETOED


# Laws


def agree(one, other):
    assert [list(robots) for robots in one.maps] == [list(robots) for robots in other.maps]
    for robot in one.T_map_base:
        assert np.allclose(se2.between(one.T_map_base[robot], other.T_map_base[robot]), 0.0, atol=1e-9)


NOISY = [
    replace(line, T_i_j=line.T_i_j + offset)
    for line, offset in zip(
        closures(A, B, MEETINGS), np.random.default_rng(0).normal(0.0, 0.05, (len(MEETINGS), 3)), strict=True
    )
]


def test_where_a_robots_own_map_has_its_origin_does_not_matter():
    reference = fuse_rigidly(ledger_of(NOISY), own_maps(a=(0, 0, 0), b=(0, 0, 0)))
    agree(fuse_rigidly(ledger_of(NOISY), own_maps(a=(0, 0, 0), b=(70.0, -30.0, 2.5))), reference)
    moved = fuse_rigidly(ledger_of(NOISY), own_maps(a=(5.0, 2.0, -1.0), b=(0, 0, 0)))
    for robot, poses in reference.T_map_base.items():
        T = se2.compose(np.array([5.0, 2.0, -1.0]), poses)
        assert np.allclose(se2.between(T, moved.T_map_base[robot]), 0.0, atol=1e-9), "a's frame is the map's"


@pytest.mark.parametrize("count", [2, len(NOISY)])
def test_no_other_motion_lays_the_matched_points_closer_to_each_other(count):
    """Least squares; of two points, eqs. (5) and (6): one direction and one middle."""
    lines = NOISY[:count]
    fused = fuse_rigidly(ledger_of(lines), own_maps(a=(0, 0, 0), b=(9.0, 9.0, 3.0)))
    in_a = np.array([se2.compose(fused.T_map_base["a"][line.i.number], line.T_i_j)[:2] for line in lines])
    in_b = np.array([fused.T_map_base["b"][line.j.number][:2] for line in lines])
    off = in_a - in_b
    assert np.allclose(off.mean(axis=0), 0.0)
    side = in_b - in_b.mean(axis=0)
    assert (side[:, 0] * off[:, 1] - side[:, 1] * off[:, 0]).sum() == pytest.approx(0.0, abs=1e-9)
    assert (side * (side + off)).sum() > 0.0


@pytest.mark.parametrize(
    "pairs",
    [[(8, 8)], [(8, 8), (8, 8), (8, 8)], [(0, 8), (8, 8)], [(8, 0), (8, 8)]],
    ids=["one", "one thrice", "one place of b", "one place of a"],
)
def test_a_place_seen_again_is_no_second_point(pairs):
    """No direction, no relation; points that coincide in one of the maps only are as useless."""
    lines = [replace(line, T_i_j=np.zeros(3)) for line in closures(A, B, pairs)]
    fused = fuse_rigidly(ledger_of(lines), own_maps(a=(0, 0, 0), b=(0, 0, 0)))
    assert fused.maps == [["a"], ["b"]]
    assert {c.status for c in fused.closures} == {ClosureStatus.VERIFIED}


@pytest.mark.parametrize("far_m", [1e12, 1e15, 1e17])
def test_a_robot_that_claims_to_be_far_away_does_not_end_the_fusion(far_m):
    """Its points are one to a computer, so nothing aligns them."""
    fused = fuse_rigidly(ledger_of(closures(A, B, MEETINGS)), own_maps(a=(0, 0, 0), b=(far_m, 0, 0)))
    assert sorted(robot for robots in fused.maps for robot in robots) == ["a", "b"]
    assert all(np.isfinite(poses).all() for poses in fused.T_map_base.values())


def test_the_two_most_similar_points_that_lie_apart_decide_which_matches_agree():
    """The most similar two lie beside each other. The first two to arrive are the least similar, and false."""
    lines = [*closures(A, B, [(0, 0), (8, 8)], shift=ALIAS), *closures(A, B, [(16, 16), (16, 16), (24, 24)])]
    log = ClosureLog()
    for line, similarity in zip(lines, (0.1, 0.2, 0.9, 0.8, 0.3), strict=True):
        log.add(PlaceMatch.verified(line.i, line.j, Channel.LIDAR, similarity, verified(line), predicted=False))
    fused = fuse_rigidly(log, own_maps(a=(0, 0, 0), b=(0, 0, 1)))
    assert [c.status is ClosureStatus.ACCEPTED for c in fused.closures] == [False, False, True, True, True]


def test_two_points_that_no_rigid_motion_lays_on_one_another_are_not_taken():
    """The first match names two places that lie apart, by more than two robots do that see one place."""
    false = [replace(line, T_i_j=np.zeros(3)) for line in closures(A, B, [(0, 8)])]
    log = ledger_of(false, closures(A, B, [(8, 8), (24, 24)]))
    fused = fuse_rigidly(log, own_maps(a=(0, 0, 0), b=(3, 4, 2)))
    assert [c.status is ClosureStatus.ACCEPTED for c in fused.closures] == [False, True, True]


def test_two_points_that_turn_a_map_against_the_headings_are_not_taken():
    """Two places taken for each other are equally far apart in both maps, and turn one of them round."""
    swapped = [replace(line, T_i_j=np.zeros(3)) for line in closures(A, B, [(8, 24), (24, 8)])]
    log = ledger_of(swapped, closures(A, B, [(0, 0), (16, 16)]))
    fused = fuse_rigidly(log, own_maps(a=(0, 0, 0), b=(3, 4, 2)))
    assert [c.status is ClosureStatus.ACCEPTED for c in fused.closures] == [False, False, True, True]


def test_words_alone_make_the_two_positions_one_in_the_live_map_as_in_the_finished_one(scripted):
    """No transform is measured: that of the script would turn the map."""
    cloud = feed(scripted(by_words(MEETINGS), fusion=RIGID), two_robots())
    live, finished = cloud.fleet.estimate(), cloud.finalize()
    assert map_of(live) == map_of(finished) == {"a": 0, "b": 0}
    assert joint_error(finished) < 1e-3
    for now, then in zip(live.robots, finished.robots, strict=True):
        assert np.allclose(se2.between(now.T_map_base, then.T_map_base), 0.0, atol=1e-6)
    for correction, robot in zip(cloud.fleet.corrections(), finished.robots, strict=True):
        assert (correction.robot, correction.map_index) == (robot.robot, robot.map_index)
        # The robots' own motions are exact here, and no closure of their own bends them.
        assert np.allclose(se2.compose(correction.T_map_odom, robot.T_local_base), robot.T_map_base, atol=1e-6)


@pytest.mark.parametrize("pairs", list(permutations(["ab", "ac", "bc"])), ids="-".join)
def test_robots_are_chained_whoever_meets_first(pairs):
    """All end in the frame of a by the two pairs that meet first; what the third pair says is not needed."""
    maps = own_maps(a=(0, 0, 0), b=(1.0, 2.0, 3.0), c=(-4.0, 2.0, 1.0))
    meetings = [
        closures((one, POSES), (other, POSES), MEETINGS[:2], shift=ALIAS if one + other == pairs[2] else None)
        for one, other in pairs
    ]
    fused = fuse_rigidly(ledger_of(*meetings), maps)
    assert fused.maps == [["a", "b", "c"]]
    for poses in fused.T_map_base.values():
        assert np.allclose(se2.between(poses, POSES), 0.0, atol=1e-9)
    assert [c.status for c in fused.closures[4:]] == [ClosureStatus.VERIFIED] * 2
