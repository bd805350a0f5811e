"""A robot that comes back again and again: what is forgotten, what never is, and that the map does not suffer."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.report import keyscan_track, run_of
from fcslam.cloud.settings import FleetConfig
from fcslam.lab.evaluation.ground_truth import labelled
from fcslam.lab.simulation.recording import true_map
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.fusion import fuse
from fcslam.metrics.grid import grid_agreement
from fcslam.metrics.trajectory import align, position_errors
from fcslam.places.matcher import MatcherConfig
from fcslam.records import Channel, Place, Veto
from fcslam.runs import open_run
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import encode
from tests import small_fleet
from tests.cloud.test_sessions import started_again
from tests.small_fleet import feed, fingerprint, in_order, map_of

pytestmark = pytest.mark.slow

SESSIONS, BETWEEN_S = 3, 1000.0
ONE_A_SQUARE = FleetConfig(matcher=MatcherConfig(most_nearby=1, nearby_m=6.0))
FEW_ENOUGH_TO_MEET = FleetConfig(matcher=MatcherConfig(most_nearby=1, nearby_m=4.0))
"""With still fewer places, sessions that meet are not joined any more."""
NEVER_FORGETS = FleetConfig(matcher=MatcherConfig(most_nearby=10**6, most_sessions_nearby=10**6))


@pytest.fixture(scope="module")
def drawn():
    return small_fleet.draw(SESSIONS, path_length_m=15.0, seed=1)


@pytest.fixture(scope="module")
def sessions(drawn):
    """Packets of one robot that comes back an hour later, and again."""
    sent = []
    for epoch, robot in enumerate(drawn.robots):
        later = replace(robot, stamps=robot.stamps + epoch * BETWEEN_S)
        sent.append(started_again(small_fleet.sent_by(later, "a"), epoch))
    return sent


@pytest.fixture(scope="module")
def packets(sessions):
    return in_order(packet for session in sessions for packet in session)


@pytest.fixture(scope="module")
def forgetful(packets):
    return feed(Cloud(ONE_A_SQUARE, 0), packets)


def places_of(sessions):
    """First and last keyscan of every place that was sent, by its session's name and number."""
    return {
        (f"a+{epoch}" if epoch else "a", packet.body.id.number): (packet.body.first, packet.body.last)
        for epoch, session in enumerate(sessions)
        for packet in session
        if isinstance(packet.body, Place)
    }


def test_a_keyscan_is_held_as_long_as_a_place_needs_it_and_no_longer(forgetful, sessions):
    (state,) = forgetful.fleet.vocabularies()
    places = places_of(sessions)
    held = {tuple(k.id) for robot in forgetful.fleet.estimate().robots for k in robot.keyscans}
    whole = [
        place for place, (first, last) in places.items() if {(place[0], k) for k in range(first, last + 1)} <= held
    ]
    assert state.places < 0.75 * len(places)
    assert state.places <= len(whole) < len(places), "places that are compared have all their keyscans"


def test_the_result_is_a_function_of_the_set_of_packets_whatever_was_forgotten(forgetful, packets):
    expected = forgetful.finalize()
    kept = [[k.id for k in robot.keyscans] for robot in expected.robots]
    shuffled = [packets[k] for k in np.random.default_rng(5).permutation(len(packets))]
    result = feed(Cloud(ONE_A_SQUARE, 0), shuffled).finalize()
    assert fingerprint(result) == fingerprint(expected)
    assert [[k.id for k in robot.keyscans] for robot in result.robots] == kept


def test_sessions_stay_joined_when_the_places_that_joined_them_are_forgotten():
    """In a small flat only the comparison of the two maps is conclusive, and one of them is no longer there."""
    drawn = small_fleet.draw(SESSIONS, path_length_m=18.0, seed=2)
    sent = [
        started_again(small_fleet.sent_by(replace(robot, stamps=robot.stamps + epoch * BETWEEN_S), "a"), epoch)
        for epoch, robot in enumerate(drawn.robots)
    ]
    packets = in_order(packet for session in sent for packet in session)
    fleet = feed(Cloud(FleetConfig(matcher=MatcherConfig(most_sessions_nearby=1)), 0), packets).fleet
    result = fleet.conclude()
    assert not result.robots[0].keyscans
    assert set(map_of(result).values()) == {0}


def test_submaps_that_are_dropped_and_built_again_change_nothing(forgetful, packets):
    cloud = feed(Cloud(ONE_A_SQUARE.model_copy(update={"submaps_kept": 2}), 0), packets)
    assert fingerprint(cloud.finalize()) == fingerprint(forgetful.finalize())


def test_a_place_described_anew_after_its_keyscans_have_gone_changes_nothing(packets, sessions):
    cloud = feed(Cloud(ONE_A_SQUARE, 0), packets)
    before, last = cloud.fleet.estimate(), sessions[0][-1]
    held = {k.id.number for robot in before.robots if robot.robot == "a" for k in robot.keyscans}
    hello = sessions[0][0].body
    assert isinstance(hello, Hello)
    gone = next(
        p.body
        for p in sessions[0]
        if isinstance(p.body, Place) and held.isdisjoint(range(p.body.first, p.body.last + 1))
    )
    anew = replace(hello, detector_versions={Channel.LIDAR: "another"}), replace(gone, detector_version="another")
    for number, body in enumerate(anew, last.sequence + 1):
        cloud.receive(encode(Packet("a", 0, number, packets[-1].time, body)))
    after = cloud.fleet.estimate()
    assert after.closures == before.closures
    assert len(cloud.finalize().robots) == SESSIONS


def surfaces(result, drawn, count):
    """Errors of all keyscans in metres, and F1 of the map, of the first ``count`` sessions."""
    robots = [robot for robot in result.robots if robot.map_index == 0]
    true = [
        small_fleet.truth_at(driver, robot.stamps - epoch * BETWEEN_S)
        for epoch, (driver, robot) in enumerate(zip(drawn.robots, robots, strict=False))
    ]
    T_truth_map = align(np.concatenate(true), np.concatenate([robot.T_map_base for robot in robots]))
    errors = position_errors(T_truth_map, np.concatenate(true), np.concatenate([r.T_map_base for r in robots]))
    keyscans = [keyscan for robot in robots for keyscan in robot.keyscans]
    poses = np.concatenate([robot.T_map_base[robot.numbers()] for robot in robots])
    fused = fuse(keyscans, poses, {robot.robot: robot.lasers for robot in robots}, OccupancyConfig())
    truth = true_map(replace(drawn, robots=drawn.robots[:count]))
    return errors, grid_agreement(labelled(fused), labelled(truth), T_truth_map).f1


def test_the_map_of_many_sessions_is_no_worse_than_that_of_few(packets, sessions, drawn):
    first_two = in_order(packet for session in sessions[:2] for packet in session)
    few = feed(Cloud(FEW_ENOUGH_TO_MEET, 0), first_two).finalize()
    many = feed(Cloud(FEW_ENOUGH_TO_MEET, 0), packets).finalize()
    whole = feed(Cloud(NEVER_FORGETS, 0), packets).finalize()
    assert sum(len(robot.keyscans) for robot in many.robots) < 0.6 * sum(len(robot.stamps) for robot in many.robots)
    assert set(map_of(few).values()) == set(map_of(many).values()) == {0}
    errors_few, f1_few = surfaces(few, drawn, 2)
    errors_many, f1_many = surfaces(many, drawn, SESSIONS)
    errors_whole, f1_whole = surfaces(whole, drawn, SESSIONS)
    assert errors_many.max() < max(errors_few.max(), errors_whole.max(), 0.03)
    assert f1_many > min(f1_few, f1_whole) - 0.02


def test_a_session_of_which_everything_was_forgotten_still_has_its_trajectory_and_empty_maps(packets, tmp_path):
    """Parted from the sessions that made it forget by a veto, it has a map of its own with nothing in it."""
    cloud = feed(Cloud(ONE_A_SQUARE, 0), packets)
    empty = next(robot.robot for robot in cloud.fleet.estimate().robots if not robot.keyscans)
    others = [robot.robot for robot in cloud.fleet.estimate().robots if robot.robot != empty]
    cloud.fleet.edit([Veto(empty, other) for other in others])
    result = cloud.fleet.estimate()
    tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
    run_of(result, tracks, [], "", OccupancyConfig()).save(tmp_path / "run")
    run = open_run(tmp_path / "run")
    (alone,) = [trajectory for trajectory in run.trajectories.values() if trajectory.robot == empty]
    assert [t.robot for t in run.trajectories.values() if t.map_index == alone.map_index] == [empty]
    assert len(alone.stamps) == len(tracks[empty].stamps) > 0
    assert run.map_files[f"map_{alone.map_index}.pgm"].startswith(b"P5")
    whole = {robot.robot: robot for robot in cloud.finalize().robots}[empty]
    assert whole.keyscans, "the veto known from the beginning, others made it forget nothing"
