"""Comparison of the maps of two sessions: what counts later, and what must be looked at again."""

import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.settings import FleetConfig
from fcslam.graph.consistency import Closures
from fcslam.graph.trajectory import build_trajectory
from fcslam.records import ClosureStatus
from tests import small_fleet
from tests.small_fleet import feed, in_order


def test_a_comparison_that_did_not_look_elsewhere_decides_no_join_after_keyscans_were_released(monkeypatch):
    drawn = small_fleet.draw(2)
    packets = in_order(packet for robot in drawn.robots for packet in small_fleet.sent_by(robot))
    fleet = feed(Cloud(FleetConfig(), 0), packets).fleet
    result = fleet.conclude()
    a, b = result.robots
    between = [
        closure
        for closure in result.closures
        if closure.status is ClosureStatus.ACCEPTED and (closure.i.robot, closure.j.robot) == (a.robot, b.robot)
    ]
    rows = [[getattr(closure, side).number for closure in between] for side in ("i", "j")]
    poses, information = (np.array([getattr(c, name) for c in between]) for name in ("T_i_j", "information"))
    members = Closures(*np.array(rows), poses, information)
    paths = [build_trajectory(robot.T_local_base) for robot in (a, b)]
    comparison = fleet._decisions.comparison
    comparison._compared.clear()

    first = comparison.fit((a.robot, b.robot), *paths, members, lambda _: False)
    numbers = SessionStore.numbers
    monkeypatch.setattr(SessionStore, "numbers", lambda self, session: numbers(self, session)[::2])
    later = comparison.fit((a.robot, b.robot), *paths, members, lambda _: True)
    assert first.seen_m == 0.0, "nobody asked whether the maps fit elsewhere"
    assert later.seen_m > 0.0, "a join depends on it"
    assert comparison.fit((a.robot, b.robot), *paths, members, lambda _: True) is later
