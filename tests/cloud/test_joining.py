"""Evidence for a join, seen from either side."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud import decisions
from fcslam.cloud.closure_log import ClosureEntry, ClosureLog
from fcslam.cloud.joining import decide_join
from fcslam.cloud.joint_graph import JointGraph
from fcslam.geometry import se2
from fcslam.graph.evidence import ConsistencySettings
from fcslam.places.matcher import PlaceMatch
from fcslam.records import Channel, ClosureStatus, Keyscan, KeyscanId, LoopClosure, Reason, ReasonCode, frozen
from fcslam.storage.state_file import read_state, write_state
from tests.scripted import CLOSURE_INFORMATION, closures, motion, rectangle, stream, verified
from tests.small_fleet import feed, map_of

pytestmark = pytest.mark.slow

POSES = rectangle(31)
SETTINGS = ConsistencySettings()
T_A_B = np.array([3.0, -2.0, 1.1])


def entry(i, j, T_i_j, information=CLOSURE_INFORMATION):
    closure = LoopClosure(
        i,
        j,
        Channel.LIDAR,
        0.5,
        frozen(T_i_j),
        frozen(information),
        ClosureStatus.VERIFIED,
        Reason(ReasonCode.VERIFIED),
    )
    return ClosureEntry(closure, independent=True)


def unexamined(*_):
    return None


def graph_of(**trajectories):
    graph = JointGraph()
    for robot, truth in trajectories.items():
        graph.start(robot)
        for k in range(1, len(truth)):
            graph.extend(motion(robot, k - 1, k, se2.between(truth[k - 1], truth[k])))
    return graph


def entries(pairs, shift=None, turned=()):
    """Closures between a and b, some of them written from b's side; b's map lies at T_A_B in a's."""
    T_a_b = T_A_B if shift is None else se2.compose(T_A_B, shift)
    found = []
    for n, line in enumerate(closures(("a", POSES), ("b", POSES), pairs, T_a_b)):
        told = (line.j, line.i, se2.inverse(line.T_i_j)) if n in turned else (line.i, line.j, line.T_i_j)
        found.append(entry(*told))
    return found


@pytest.mark.parametrize("turned", [(), (1, 2)])
def test_the_verdict_is_the_same_from_both_sides(turned):
    graph = graph_of(a=POSES, b=POSES)
    evidence = entries([(0, 0), (8, 8), (16, 16), (24, 24)], turned=turned)
    evidence += entries([(4, 4), (12, 12)], shift=np.array([5.0, 1.0, 0.3]))
    for robots in (("a", "b"), ("b", "a")):
        verdict = decide_join(evidence, robots, graph, SETTINGS, unexamined)
        assert verdict.members == (0, 1, 2, 3)
        assert verdict.evidence.rival_closures == 2
        assert verdict.dominant
        assert not verdict.contested


@pytest.mark.parametrize(("rivals", "contested"), [([(4, 4), (12, 12), (20, 20)], True), ([(4, 4), (12, 12)], False)])
def test_only_a_rival_that_could_join_two_maps_contests_the_cluster(rivals, contested):
    graph = graph_of(a=POSES, b=POSES)
    evidence = entries([(0, 0), (8, 8), (16, 16)]) + entries(rivals, shift=np.array([5.0, 1.0, 0.3]))
    verdict = decide_join(evidence, ("a", "b"), graph, SETTINGS, unexamined)
    assert not verdict.dominant
    assert verdict.contested is contested


def test_the_ledger_books_what_geometry_says():
    ledger = ClosureLog()
    (line,) = closures(("a", POSES), ("b", POSES), [(3, 4)])
    confirmed = ledger.add(PlaceMatch.verified(line.i, line.j, Channel.CAMERA, 0.4, verified(line), predicted=False))
    assert confirmed.closure.status is ClosureStatus.VERIFIED
    assert ledger.evidence("a", "b") == ledger.evidence("b", "a") == [confirmed]
    assert [ledger.has(line.i, line.j, channel) for channel in (Channel.CAMERA, Channel.LIDAR)] == [True, False]
    unconfirmed = replace(verified(line), strict=False)
    doubtful = ledger.add(PlaceMatch.verified(line.i, line.j, Channel.LIDAR, 0.4, unconfirmed, False))
    assert doubtful.closure.status is ClosureStatus.CANDIDATE
    assert (confirmed.closure.channel, doubtful.closure.channel) == (Channel.CAMERA, Channel.LIDAR)
    predicted = ledger.add(PlaceMatch.verified(line.i, line.j, Channel.CAMERA, 0.4, unconfirmed, True))
    assert predicted.closure.status is ClosureStatus.VERIFIED, "the loose gate counts where a map is shared"
    ledger.add_local(motion("a", 1, 9, np.array([1.0, 0.0, 0.0])), edge=8)
    assert ledger.evidence("a", "b") == [confirmed], "what the joint map predicted is no evidence for it"
    confirmed.vetoed = True
    assert ledger.evidence("a", "b") == []


def without_returns(packet):
    """The scripted walls do not fit each other; without any, no map contradicts."""
    if not isinstance(packet.body, Keyscan):
        return packet
    return replace(packet, body=replace(packet.body, ranges_m=np.zeros_like(packet.body.ranges_m)))


def test_sessions_that_meet_for_long_without_a_join_are_not_decided_at_every_place(scripted, monkeypatch):
    poses, sizes = rectangle(801), []

    def counted(found, *rest):
        sizes.append(len(found))
        return decide_join(found, *rest)

    monkeypatch.setattr(decisions, "decide_join", counted)
    a, b = ("a", poses), ("b", poses)
    vague = closures(a, b, [(k, k) for k in range(0, 600, 4)], informative=False)
    clear = closures(a, b, [(k, k) for k in range(600, 801, 4)])
    packets = [*stream("a", poses, start_s=0.0), *stream("b", poses, start_s=1e4)]
    cloud = feed(scripted(vague, clear), [without_returns(packet) for packet in packets])
    assert sizes[:20] == list(range(1, 21)), "with little evidence they are"
    grown = np.array(sizes[20:])
    assert (grown[1:] >= 1.05 * grown[:-1]).all()
    assert len(vague) < grown[-1] < 1.06 * len(vague), "they join soon after closures say where"
    assert set(map_of(cloud.finalize()).values()) == {0}


def test_a_solve_is_of_the_maps_whose_closures_changed_also_after_a_restart(tmp_path):
    graph = graph_of(a=POSES, b=POSES, c=POSES)
    a, b = (graph.trajectory(robot) for robot in "ab")
    bent = se2.compose(se2.between(POSES[0], POSES[20]), np.array([0.3, 0.1, 0.02]))
    for robot in "bc":
        graph.close(KeyscanId(robot, 0), KeyscanId(robot, 20), bent, np.eye(3))
    graph.optimize()
    solved = graph.trajectory("c")
    assert np.allclose(graph.trajectory("a"), a, atol=1e-9)
    assert not np.allclose(graph.trajectory("b"), b, atol=1e-3)
    graph.close(KeyscanId("a", 0), KeyscanId("a", 20), bent, np.eye(3))
    graph.count(graph.close(KeyscanId("b", 0), KeyscanId("b", 20), bent, np.eye(3)), holds=False)
    write_state(tmp_path / "state", "test", graph.state())
    again = JointGraph()
    again.restore(read_state(tmp_path / "state", "test"))
    for each in (graph, again):
        each.optimize()
    assert not np.allclose(graph.trajectory("a"), a, atol=1e-3)
    assert np.allclose(graph.trajectory("c"), solved, atol=1e-9)
    assert all(np.array_equal(graph.trajectory(robot), again.trajectory(robot)) for robot in "abc")
