"""A robot that sends what others saw in two buildings joins these, unless their maps contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.records import Constraint, ConstraintKind, Keyscan, KeyscanId, Place, ReasonCode, frozen
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.small_fleet import feed, in_order, map_of

pytestmark = [pytest.mark.slow, pytest.mark.attack]

SEAM = 4e2 * np.eye(3)
"""Information of the motion between the buildings: 5 cm, 0.05 rad."""


def building(seed, name, robots=2):
    """Packets of robots that drive through one building."""
    fleet = small_fleet.draw(robots, 9.0, seed=seed).robots
    return {f"{name}_{robot.name}": sent(robot, f"{name}_{robot.name}") for robot in fleet}


def sent(robot, name):
    return [decode(encode(packet)) for packet in small_fleet.sent_by(robot, name)]


def bridge(first, second, T_seam):
    """Packets of a robot that copies two streams, the second one after a motion ``T_seam``."""
    scans = sum(isinstance(packet.body, Keyscan) for packet in first)

    def later(body):
        match body:
            case Keyscan():
                return replace(body, id=KeyscanId("bridge", body.id.number + scans))
            case Constraint():
                return replace(body, i=body.i + scans, j=body.j + scans)
            case Place():
                id_ = KeyscanId("bridge", body.id.number + scans)
                return replace(body, id=id_, first=body.first + scans, last=body.last + scans)

    T_i_j, information = frozen(np.array(T_seam)), frozen(SEAM)
    seam = Constraint("bridge", scans - 1, scans, ConstraintKind.ODOMETRY, T_i_j, information)
    rest = [later(packet.body) for packet in second if not isinstance(packet.body, Hello)]
    bodies = [*(packet.body for packet in first), rest[0], seam, *rest[1:]]
    times = np.linspace(first[0].time, second[-1].time + 60.0, len(bodies))
    return [
        replace(first[0], robot="bridge", sequence=number, time=float(time), body=named(body))
        for number, (time, body) in enumerate(zip(times, bodies, strict=True))
    ]


def named(body):
    if isinstance(body, Keyscan | Place):
        return replace(body, id=KeyscanId("bridge", body.id.number))
    return replace(body, robot="bridge")


def mapped(*streams):
    return feed(Cloud(FleetConfig(), 0), in_order(packet for stream in streams for packet in stream)).finalize()


@pytest.fixture(scope="module")
def buildings():
    return building(2, "a"), building(5, "b")


@pytest.mark.parametrize("T_seam", [(3.0, 2.0, 1.0), (8.0, 3.0, 2.0)])
def test_a_forged_bridge_does_not_join_two_buildings(buildings, T_seam):
    first, second = buildings
    forged = bridge(first["a_robot_1"], second["b_robot_1"], T_seam)
    found = mapped(*first.values(), *second.values(), forged)
    maps = map_of(found)
    assert maps["a_robot_1"] == maps["a_robot_2"]
    assert maps["b_robot_1"] == maps["b_robot_2"]
    assert maps["a_robot_1"] != maps["b_robot_1"]
    reasons = {c.reason.code for c in found.closures if "bridge" in (c.i.robot, c.j.robot) and c.status == "revoked"}
    assert reasons == {ReasonCode.FALSE_BRIDGE}


def test_a_forged_bridge_to_where_nobody_else_was_is_not_found(buildings):
    """No map contradicts it: the two buildings could stand side by side."""
    first, second = buildings
    forged = bridge(first["a_robot_1"], second["b_robot_1"], (0.0, 19.0, 0.0))
    assert set(map_of(mapped(*first.values(), *second.values(), forged)).values()) == {0}
