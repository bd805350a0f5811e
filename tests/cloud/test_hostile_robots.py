"""A robot that copies another one's packets and deforms them: it bends nobody's map, and closures.csv tells why."""

from dataclasses import replace

import numpy as np
import pytest
from byzantine import LIES, paths

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.records import ClosureStatus, Constraint, Keyscan, KeyscanId, Place, ReasonCode, Removal, frozen
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.small_fleet import fingerprint, in_order, map_of, restored

pytestmark = [pytest.mark.slow, pytest.mark.attack]

PRECISE = frozen(np.diag((1e6, 1e6, 2.5e7)))
"""More precise than scan matching ever is: 1 mm, 0.2 mrad."""


def scaled(packets, name, scale):
    """Packets of a robot called ``name`` that copies another one's packets, with all lengths scaled."""

    def changed(body):
        match body:
            case Keyscan():
                ranges_m = frozen(body.ranges_m * scale, np.float32)
                return replace(body, id=KeyscanId(name, body.id.number), ranges_m=ranges_m)
            case Constraint():
                T_i_j = frozen(body.T_i_j * (scale, scale, 1.0))
                return replace(body, robot=name, T_i_j=T_i_j, information=PRECISE)
            case Place():
                keypoints = frozen(body.keypoints * scale, np.float32)
                return replace(body, id=KeyscanId(name, body.id.number), keypoints=keypoints)
            case _:
                return replace(body, robot=name)

    return [replace(packet, robot=name, body=changed(packet.body)) for packet in packets]


def fed(packets):
    cloud = Cloud(FleetConfig(), 0)
    for packet in packets:
        cloud.apply(packet)
    return cloud


@pytest.fixture(scope="module")
def honest():
    """Packets of two robots in a building in which a copy bends their paths and no closure shows it."""
    robots = small_fleet.draw(2, 30.0, seed=5).robots
    return in_order(decode(encode(packet)) for robot in robots for packet in small_fleet.sent_by(robot))


@pytest.fixture(scope="module")
def alone(honest):
    return fed(honest).finalize()


@pytest.fixture(scope="module")
def packets(honest):
    copied = [packet for packet in honest if packet.robot == "robot_2"]
    return in_order([*honest, *scaled(copied, "evil", 1.02)])


@pytest.fixture(scope="module")
def attacked(packets):
    return fed(packets)


def between(result, *, evil):
    """Decided closures between two robots, with the evil one or without."""
    found = [c for c in result.closures if c.i.robot != c.j.robot and c.status is not ClosureStatus.CANDIDATE]
    return [closure for closure in found if ("evil" in (closure.i.robot, closure.j.robot)) is evil]


def test_a_scaled_copy_gets_a_map_of_its_own(alone, attacked):
    found = attacked.finalize()
    assert map_of(alone) == {"robot_1": 0, "robot_2": 0}
    assert map_of(found) == map_of(alone) | {"evil": 1}
    now, then = ({robot.robot: robot.T_map_base for robot in result.robots} for result in (found, alone))
    for name in then:
        assert np.abs(now[name] - then[name])[:, :2].max() < 0.05
    honest_closures = between(found, evil=False)
    assert ClosureStatus.REVOKED not in {closure.status for closure in honest_closures}
    assert sum(closure.status is ClosureStatus.ACCEPTED for closure in honest_closures) > 30
    reasons = {closure.reason.code for closure in between(found, evil=True)}
    assert reasons == {ReasonCode.WALLS_DIFFER}


def test_a_copy_at_a_false_scale_of_a_percent_gets_a_map_of_its_own_too(honest, alone):
    copied = [packet for packet in honest if packet.robot == "robot_2"]
    found = fed(in_order([*honest, *scaled(copied, "evil", 1.01)])).finalize()
    assert map_of(found) == map_of(alone) | {"evil": 1}
    now, then = ({robot.robot: robot.T_map_base for robot in result.robots} for result in (found, alone))
    xy, wanted = (np.concatenate([those[name][:, :2] for name in then]) for those in (now, then))
    assert np.hypot(*(se2.transform(n_point_alignment(wanted, xy), xy) - wanted).T).max() < 0.01


def test_a_restored_fleet_keeps_robots_apart(packets, attacked, tmp_path):
    again = restored(attacked.fleet, packets, tmp_path / "state")
    assert fingerprint(again.conclude()) == fingerprint(attacked.fleet.conclude())


@pytest.fixture(scope="module")
def fleet():
    """What each of three robots sends, and the result of the first two."""
    robots = small_fleet.draw(3, 15.0, seed=5).robots
    streams = [[decode(encode(packet)) for packet in small_fleet.sent_by(robot)] for robot in robots]
    return streams, fed(in_order([*streams[0], *streams[1]])).finalize()


@pytest.mark.parametrize("lie", LIES)
def test_a_robot_that_lies_about_places_or_closures_moves_nobody_and_leaves_no_byte(lie, fleet):
    (first, second, hostile), alone = fleet
    cloud = fed(in_order([*first, *second, *LIES[lie](hostile, first)]))
    found = cloud.finalize()
    now, then = ({robot.robot: robot.T_map_base for robot in result.robots} for result in (found, alone))
    assert {name: map_of(found)[name] for name in then} == map_of(alone)
    xy, wanted = (np.concatenate([those[name][:, :2] for name in then]) for those in (now, then))
    assert np.hypot(*(se2.transform(n_point_alignment(wanted, xy), xy) - wanted).T).max() < 0.02
    cloud.fleet.edit([Removal(hostile[0].robot, 0)])
    assert paths(cloud.finalize()) == paths(alone)
