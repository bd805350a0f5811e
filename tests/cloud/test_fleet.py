"""Decisions of the fleet: it joins on true clusters, refuses aliases, and revokes closures that the rest
contradicts.
"""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.places.matcher import MatcherConfig
from fcslam.records import ClosureStatus, ConstraintKind, Correction, KeyscanId, Place, Reason, ReasonCode, Veto
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.scripted import ALIAS, ScriptedMatcher, closures, motion, rectangle, stream
from tests.small_fleet import feed, fingerprint, in_order, map_of

pytestmark = pytest.mark.slow

POSES = rectangle()
A, B, C = ("a", POSES), ("b", POSES), ("c", POSES)
LATER = 1000.0
"""Robot b drives when a has long been home, so b's places bring the closures."""
TRUE = [(0, 0), (8, 8), (16, 16), (24, 24), (32, 32), (40, 40)]
OTHERS = [(4, 4), (12, 12), (20, 20), (28, 28), (36, 36), (44, 44)]


def two_robots():
    return [*stream(*A, start_s=0.0), *stream(*B, start_s=LATER)]


def between(result, status=None):
    found = [c for c in result.closures if c.i.robot != c.j.robot]
    return found if status is None else [c for c in found if c.status is status]


def is_place_of(packet, robot):
    return isinstance(packet.body, Place) and packet.robot == robot


def joint_error(result, robot_a="a", robot_b="b", truth=POSES):
    """How far robot b's keyscans lie from the truth, seen from a's first, in metres; a and b drove the same poses."""
    poses = {robot.robot: robot.T_map_base for robot in result.robots}
    seen = se2.between(poses[robot_a][0], poses[robot_b])
    return np.hypot(*(seen - se2.between(truth[0], truth))[:, :2].T).max()


def test_a_true_cluster_joins_two_robots_and_leaves_aliases_out(scripted):
    cloud = scripted(closures(A, B, TRUE), closures(A, B, OTHERS[:3], shift=ALIAS))
    result = feed(cloud, two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 0}
    assert joint_error(result) < 1e-3
    assert len(between(result, ClosureStatus.ACCEPTED)) == len(TRUE)
    assert len(result.graph.edges) == 2 * (len(POSES) - 1) + len(TRUE), "each closure once"
    rejected = between(result, ClosureStatus.REJECTED)
    assert len(rejected) == 3
    assert {closure.reason.code for closure in rejected} == {ReasonCode.CONTRADICTS_JOINT_GRAPH}


@pytest.mark.parametrize("count", [3, 6])
def test_robots_stay_apart_while_two_clusters_are_alike(scripted, count):
    """True and alias closures take turns, so neither ever has twice as many as the other."""
    alias = closures(A, B, OTHERS[:count], shift=ALIAS)
    result = feed(scripted(closures(A, B, TRUE[:count]), alias), two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert not between(result, ClosureStatus.ACCEPTED)


@pytest.mark.parametrize(
    "pairs",
    [
        [(0, 0), (1, 4), (2, 8), (0, 12)],  # four places of b, one of a
        [(0, 8), (20, 8), (40, 8)],  # one place of b that looks like three of a
    ],
    ids=["one place of a", "one place of b"],
)
def test_closures_from_one_place_are_one_witness(scripted, pairs):
    stands = POSES.copy()
    stands[:3] = stands[0]
    a = ("a", stands)
    lines = [line for pair in pairs for line in closures(a, B, [pair])]
    base = lines[0]
    # whatever they measure, they say the same about how the robots lie to each other
    T_a_b = se2.compose(stands[base.i.number], se2.compose(base.T_i_j, se2.inverse(POSES[base.j.number])))
    agreeing = [
        replace(line, T_i_j=se2.between(stands[line.i.number], se2.compose(T_a_b, POSES[line.j.number])))
        for line in lines
    ]
    result = feed(scripted(agreeing), [*stream(*a, start_s=0.0), *stream(*B, start_s=LATER)]).finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert {c.status for c in between(result)} == {ClosureStatus.REJECTED}
    assert between(result)[0].reason.code is ReasonCode.NOT_UNIQUE


def test_corridors_alone_join_nothing_but_one_informative_place_among_them_does(scripted):
    corridor = closures(A, B, TRUE, informative=False)
    apart = feed(scripted(corridor), two_robots()).finalize()
    assert map_of(apart) == {"a": 0, "b": 1}
    assert between(apart)[0].reason.code is ReasonCode.NOT_INFORMATIVE
    joined = feed(scripted(corridor, closures(A, B, OTHERS[-1:])), two_robots()).finalize()
    assert map_of(joined) == {"a": 0, "b": 0}


def test_a_join_on_aliases_does_not_outlive_evidence_that_contradicts_it(scripted):
    """Three aliases came first, five true closures later: neither cluster is twice the other, so nobody knows.

    The aliases do not fit perfectly, but nothing of the bend that they made remains.
    """
    alias = closures(A, B, [(0, 0), (4, 4), (8, 8)], shift=ALIAS)
    alias[1] = replace(alias[1], T_i_j=alias[1].T_i_j + np.array([0.04, 0.03, 0.01]))
    result = feed(scripted(alias, closures(A, B, [(k, k) for k in range(12, 32, 4)])), two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert not between(result, ClosureStatus.ACCEPTED)
    for robot in result.robots:
        assert np.allclose(se2.between(se2.between(robot.T_map_base[0], robot.T_map_base), POSES), 0.0, atol=1e-6)


def test_a_join_on_aliases_is_taken_back_while_the_robots_drive(scripted):
    """At the next solve after the evidence turned, not only at the end."""
    pairs = [(k, k) for k in range(12, 61, 4)]
    cloud = scripted(closures(A, B, [(0, 0), (4, 4), (8, 8)], shift=ALIAS), closures(A, B, pairs), solve_every=1)
    packets = two_robots()
    at = {packet.body.id.number: n for n, packet in enumerate(packets) if is_place_of(packet, "b")}
    accepted, maps, map_index = [], [], {}
    for packet in packets:
        replies = [decode(reply).body for reply in cloud.receive(encode(packet))]
        accepted.append(cloud.fleet.closure_counts()["between robots"])
        map_index |= {reply.robot: reply.map_index for reply in replies if isinstance(reply, Correction)}
        maps.append(map_index.get("b"))
    assert (accepted[at[4]], maps[at[4]]) == (0, 1)
    assert (accepted[at[8]], maps[at[8]]) == (3, 0), "three aliases join the two"
    assert (accepted[at[20]], maps[at[20]]) == (0, 1), "three true closures: undecided"
    assert accepted[-1] == len(pairs)
    assert maps[at[60]] == 0


def test_maps_that_are_separated_are_compared_where_the_false_join_hid_the_truth(scripted):
    """Three surprises end a join on aliases. The other true pairs lay far apart in the false joint map."""
    hidden = [replace(line, predictable=False) for line in closures(A, B, [(k, k) for k in range(12, 48, 4)])]
    found = closures(A, B, [(48, 48), (52, 52), (56, 56)])
    alias = closures(A, B, [(0, 0), (4, 4), (8, 8)], shift=ALIAS)
    result = feed(scripted(alias, hidden, found, solve_every=1), two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 0}
    assert joint_error(result) < 1e-3
    assert len(between(result, ClosureStatus.ACCEPTED)) == len(hidden) + len(found)


def test_a_veto_parts_what_only_liars_joined(scripted):
    """Six aliases and no witness of the truth: only somebody who knows can tell. He may say so at any time."""
    alias = closures(A, B, TRUE, shift=ALIAS)
    cloud = feed(scripted(alias), two_robots())
    assert cloud.fleet.closure_counts()["between robots"] == 6
    cloud.fleet.edit([Veto("b", "a")])
    assert cloud.fleet.closure_counts()["between robots"] == 0
    result = cloud.finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert {(c.status, c.reason) for c in between(result)} == {(ClosureStatus.REVOKED, Reason(ReasonCode.VETOED))}
    before = scripted(alias)
    before.fleet.edit([Veto("a", "b")])
    assert fingerprint(feed(before, two_robots()).finalize()) == fingerprint(result)


def test_a_veto_clears_the_way_for_the_truth_whenever_it_comes(scripted):
    """Four aliases keep six true closures from joining; vetoed, before or after, they do so no more."""
    alias = closures(A, B, OTHERS[:4], shift=ALIAS)
    vetoes = [Veto("a", "b", (float(i), LATER + j)) for i, j in OTHERS[:4]]
    late = feed(scripted(alias, closures(A, B, TRUE)), two_robots())
    assert late.fleet.closure_counts()["between robots"] == 0
    late.fleet.edit(vetoes)
    assert late.fleet.closure_counts()["between robots"] == len(TRUE)
    early = scripted(alias, closures(A, B, TRUE))
    early.fleet.edit(vetoes)
    result = late.finalize()
    assert map_of(result) == {"a": 0, "b": 0}
    assert fingerprint(result) == fingerprint(feed(early, two_robots()).finalize())


def test_a_robots_own_closure_can_be_vetoed(scripted):
    loop = motion("a", 2, 58, se2.between(POSES[2], POSES[58]), ConstraintKind.CLOSURE)
    cloud = scripted()
    cloud.fleet.edit([Veto("a", "a", (58.0, 2.0))])
    (closure,) = feed(cloud, stream(*A, start_s=0.0, local=[loop])).finalize().closures
    assert (closure.status, closure.reason) == (ClosureStatus.REVOKED, Reason(ReasonCode.VETOED))


def test_one_surviving_closure_holds_no_maps_together(scripted):
    """A closure that fits the joint map only because of a join falls with the join."""
    follower = closures(A, B, [(20, 20)], shift=ALIAS)
    cloud = feed(scripted(closures(A, B, [(0, 0), (8, 8), (16, 16)], shift=ALIAS), follower), two_robots())
    assert cloud.fleet.closure_counts()["between robots"] == 4
    cloud.fleet.edit([Veto("a", "b", (number, LATER + number)) for number in (0, 8)])
    result = cloud.finalize()
    assert map_of(result) == {"a": 0, "b": 1}
    assert not between(result, ClosureStatus.ACCEPTED)


@pytest.mark.parametrize("off", [(0.8, 0.0, 0.0), (0.0, 0.0, 0.2)])
def test_in_a_joint_map_a_surprise_needs_a_cluster(scripted, off):
    """Too far away or too much turned: unlike a small contradiction it is not even tried."""
    (surprise,) = closures(A, B, [(20, 20)])
    surprise = replace(surprise, T_i_j=surprise.T_i_j + np.array(off))
    cloud = feed(scripted(closures(A, B, TRUE), [surprise]), two_robots())
    assert cloud.fleet.closure_counts()["between robots"] == len(TRUE)
    (rejected,) = between(cloud.finalize(), ClosureStatus.REJECTED)
    assert rejected.i.number == 20


def test_in_a_joint_map_near_places_of_other_robots_are_predicted(scripted):
    """The nearest place of each of two visits within sight, where the joint map says it is."""
    rounds = ("a", rectangle(181))  # passes every spot three times
    b = ("b", rectangle(63)[2:])  # its places lie between those of a
    feed(scripted(closures(rounds, b, TRUE)), [*stream(*rounds, start_s=0.0), *stream(*b, start_s=LATER)])
    assert not ScriptedMatcher.predictions[KeyscanId("b", 8)], "not yet in one map"
    for number in range(20, 61, 4):
        predicted = ScriptedMatcher.predictions[KeyscanId("b", number)]
        assert len(predicted) == 2
        for place, T_i_j in predicted.items():
            assert place.robot == "a"
            assert np.hypot(T_i_j[0], T_i_j[1]) < 2.01
            true = se2.between(rounds[1][place.number], b[1][number])
            assert np.allclose(se2.between(T_i_j, true), 0.0, atol=1e-3)


def test_a_closure_that_contradicts_the_joint_graph_ends_revoked(scripted):
    """0.4 m off is no surprise and goes in at once, but twelve standard deviations are too many for the end."""
    wrong = closures(A, B, [(20, 20)], shift=np.array([0.4, 0.0, 0.0]))
    cloud = feed(scripted(closures(A, B, TRUE), wrong), two_robots())
    assert cloud.fleet.closure_counts()["between robots"] == len(TRUE) + 1
    result = cloud.finalize()
    (revoked,) = between(result, ClosureStatus.REVOKED)
    assert (revoked.i.number, revoked.reason) == (20, Reason(ReasonCode.CONTRADICTS_JOINT_GRAPH))
    assert joint_error(result) < 1e-3
    assert len(result.graph.edges) == 2 * (len(POSES) - 1) + len(TRUE), "the revoked edge is left out"


def test_a_robots_own_closure_may_be_revoked_too(scripted):
    wrong = se2.between(POSES[2], POSES[58]) + np.array([2.0, 0.0, 0.0])
    loop = motion("a", 2, 58, wrong, ConstraintKind.CLOSURE)
    true = [
        motion("a", i, j, se2.between(POSES[i], POSES[j]), ConstraintKind.CLOSURE)
        for i, j in ((0, 60), (1, 59), (3, 57))
    ]
    result = feed(scripted(), stream(*A, start_s=0.0, local=[*true, loop])).finalize()
    assert [c.status for c in result.closures] == [*[ClosureStatus.ACCEPTED] * 3, ClosureStatus.REVOKED]
    assert np.allclose(se2.between(result.robots[0].T_map_base, POSES), 0.0, atol=1e-3)


@pytest.mark.parametrize("names", ["abcd", "dbca"])
def test_maps_of_several_robots_join_whoever_came_first(scripted, names):
    """Two pairs of robots join first, then the pairs: each map moves as a whole, into the older one's frame."""
    w, x, y, z = names
    early, late = [(k, k) for k in range(0, 24, 4)], [(k, k) for k in range(28, 61, 4)]

    def pair(robots, pairs):
        one, other = sorted(robots)  # the later robot brings the closures
        return closures((one, POSES), (other, POSES), pairs)

    meetings = pair((w, x), early), pair((y, z), early), pair((x, y), late)
    packets = [p for k, name in enumerate("abcd") for p in stream(name, POSES, start_s=0.1 * k)]
    result = feed(scripted(*meetings), in_order(packets)).finalize()
    assert map_of(result) == dict.fromkeys("abcd", 0)
    assert all(joint_error(result, "a", robot) < 1e-3 for robot in "bcd")
    assert np.array_equal(result.robots[0].T_map_base[0], np.zeros(3)), "in the frame of the robot that began first"


def test_a_single_closure_joins_where_the_configuration_asks_for_no_more(scripted):
    cloud = scripted(closures(A, B, TRUE[2:3]), consistency={"minimum_closures": 1, "minimum_evidence": 1})
    result = feed(cloud, two_robots()).finalize()
    assert map_of(result) == {"a": 0, "b": 0}
    assert joint_error(result) < 1e-3


def test_the_largest_map_is_the_first(scripted):
    cloud = scripted(closures(B, C, TRUE))
    packets = [*two_robots(), *stream(*C, start_s=2 * LATER)]
    assert map_of(feed(cloud, packets).finalize()) == {"b": 0, "c": 0, "a": 1}


def test_robots_that_met_lie_as_they_drove(drawn, packets):
    """Across robots, every pair of keyscans within sight is measured to the centimetre."""
    result = feed(Cloud(FleetConfig(), seed=0), packets).finalize()
    assert set(map_of(result).values()) == {0}
    truth = {robot.name: robot for robot in drawn.robots}
    first, *others = result.robots
    T_first = small_fleet.truth_at(truth[first.robot], [k.stamp for k in first.keyscans])
    for other in others:
        T_other = small_fleet.truth_at(truth[other.robot], [k.stamp for k in other.keyscans])
        for i in range(0, len(T_first), 5):
            true, seen = se2.between(T_first[i], T_other), se2.between(first.T_map_base[i], other.T_map_base)
            near = np.hypot(true[:, 0], true[:, 1]) < 5.0
            assert np.all(np.hypot(*(seen - true)[near, :2].T) < 0.05)


@pytest.fixture(scope="module")
def reference(packets):
    """The result of the packets in canonical order."""
    return fingerprint(feed(Cloud(FleetConfig(), seed=0), packets).finalize())


def test_the_result_is_a_function_of_the_set_of_packets(reference, packets):
    rng = np.random.default_rng(0)
    twice = [*packets, *(packets[k] for k in rng.integers(0, len(packets), 200))]
    shuffled = [twice[k] for k in rng.permutation(len(twice))]
    assert fingerprint(feed(Cloud(FleetConfig(), seed=0), shuffled).finalize()) == reference


def test_every_beginning_of_a_recording_has_a_result(scripted):
    """A connection may break after any packet."""
    packets = in_order([*stream("a", POSES[:12], start_s=0.0), *stream("b", POSES[:12], start_s=0.5)])
    for length in range(len(packets) + 1):
        result = feed(scripted(closures(A, B, [(0, 0), (4, 4), (8, 8)])), packets[:length]).finalize()
        for robot in result.robots:
            assert len(robot.keyscans) == len(robot.T_map_base) > 0
            assert robot.keyscans[-1].id == KeyscanId(robot.robot, len(robot.keyscans) - 1)


def rounds(count):
    """Two robots that drive round the same block, one after the other, ``count`` times each; a place every 4 m."""
    way = rectangle(60 * count + 1)
    return [*stream("a", way, start_s=0.0), *stream("b", way, start_s=LATER)]


def places_kept(cloud):
    (state,) = cloud.fleet.vocabularies()
    return state.places


def test_of_many_places_of_one_robot_at_one_spot_the_oldest_are_forgotten():
    settings = MatcherConfig(most_nearby=2, nearby_m=1.0)
    cloud = feed(Cloud(FleetConfig(matcher=settings), 0), rounds(5))
    last_two = len(range(184, 301, 4))  # the fourth round's first place is where the fifth one ended
    assert places_kept(cloud) == 2 * last_two
    everything = feed(Cloud(FleetConfig(), 0), rounds(5))
    assert places_kept(everything) == 2 * len(range(0, 301, 4))
    kept, all_of_it = cloud.finalize(), everything.finalize()
    assert np.array_equal(kept.graph.poses(), all_of_it.graph.poses())
    assert kept.closures == all_of_it.closures
    few = feed(Cloud(FleetConfig(matcher=settings.model_copy(update={"most_places": 10})), 0), rounds(5))
    assert places_kept(few) == 10, "those forgotten by age take nobody's room"


@pytest.mark.parametrize("late", [0, 1])
def test_the_next_result_goes_on_from_the_replay_of_the_last_one(scripted, monkeypatch, late):
    """Unless a packet is late: then it is earlier in canonical order than some of the replay."""
    packets = in_order(two_robots())
    half = len(packets) // 2
    arrived = [packets[1], packets[0], *packets[2 : half - late], *packets[half:], *packets[half - late : half]]
    expected = fingerprint(feed(scripted(closures(A, B, TRUE)), packets).finalize())
    cloud = feed(scripted(closures(A, B, TRUE)), arrived[:-20])
    cloud.finalize()
    feed(cloud, arrived[-20:])
    applied = []
    apply = Fleet.apply
    monkeypatch.setattr(Fleet, "apply", lambda fleet, packet: applied.append(packet) or apply(fleet, packet))
    assert fingerprint(cloud.finalize()) == expected
    assert len(applied) == (len(packets) if late else 20)


def test_a_result_changes_nothing(scripted):
    looked, never = (scripted(closures(A, B, TRUE), closures(A, B, OTHERS[:3], shift=ALIAS)) for _ in range(2))
    for packet in in_order(two_robots()):
        assert looked.receive(encode(packet)) == never.receive(encode(packet))
        if isinstance(packet.body, Place) and packet.sequence % 5 == 0:
            looked.finalize()
    assert fingerprint(looked.fleet.estimate()) == fingerprint(never.fleet.estimate())
    assert fingerprint(looked.finalize()) == fingerprint(never.finalize())
