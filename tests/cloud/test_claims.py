"""Bounds on what a robot may claim."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.claims import ClaimLimits, check_submap, with_least_noise
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError
from fcslam.lidar.frontend import motion_information
from fcslam.lidar.odometry import WHEELS
from fcslam.lidar.tracker import TrackedScan
from fcslam.records import Channel, ConstraintKind, LaserModel, frozen
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import encode
from tests.scripted import keyscan, motion, place

FAR_LASER = LaserModel(8, -np.pi, np.pi / 4, 10.0)


def sent(bodies):
    return [Packet("a", 0, number, 1e3, body) for number, body in enumerate(bodies)]


def drive(steps):
    """Hello, and keyscans with these motions (N, 3) between them."""
    bodies = [Hello("a", 0, (FAR_LASER,), {Channel.LIDAR: "test-1"}), keyscan("a", 0, 0.0)]
    for k, step in enumerate(steps):
        bodies += [keyscan("a", k + 1, 1.0 + k), motion("a", k, k + 1, np.array(step))]
    return bodies


def refusals(bodies, **limits):
    """Why the cloud refuses the packets, by their numbers."""
    cloud, found = Cloud(FleetConfig(claims=ClaimLimits(**limits)), 0), {}
    for packet in sent(bodies):
        try:
            cloud.receive(encode(packet))
        except PacketError as error:
            found[packet.sequence] = str(error)
    cloud.finalize()  # whatever came, there is a result
    return found


AHEAD = (1.0, 0.0, 0.0)


@pytest.mark.parametrize("length_m", [21.0, 1.8e3, 1.7e5])
def test_a_motion_that_no_robot_makes_is_refused(length_m):
    bodies = drive([AHEAD, (length_m, 0.0, 0.0), AHEAD])
    reasons = refusals(bodies)
    assert f"constraint 1 to 2 is {length_m:.4g} m long, at most 20 m" in reasons[5]
    assert "does not lead to a new keyscan" in reasons[7] or "before the motion" in reasons[6]
    assert refusals(drive([AHEAD] * 3)) == {}


def test_a_submap_wider_than_any_is_refused():
    """Each motion is allowed, their sum is not."""
    bodies = [*drive([(15.0, 0.0, 0.0)] * 12), place("a", 4, first=0, last=12), place("a", 8, first=4, last=12)]
    (number,), (reason,) = zip(*refusals(bodies).items(), strict=True)
    assert number == len(bodies) - 2
    assert "keyscan 120 m away, at most 100 m" in reason


def test_a_submap_of_too_many_keyscans_is_refused():
    with pytest.raises(PacketError, match="has 2001 keyscans, at most 2000"):
        check_submap(place("a", 4, first=0, last=2000), np.zeros((2001, 3)))


def test_a_robot_does_not_leave_the_building():
    (first, *_) = refusals(drive([(15.0, 0.0, 0.0)] * 10), distance_m=100.0).values()
    assert "105 m off its start, at most 100 m" in first


def test_an_own_closure_over_a_distance_is_refused():
    closure = motion("a", 0, 3, np.array((60.0, 0.0, 0.0)), ConstraintKind.CLOSURE)
    (reason,) = refusals([*drive([AHEAD] * 3), closure]).values()
    assert "60 m long, at most 50 m" in reason


@pytest.mark.parametrize(
    ("information", "refused"),
    [((1e6, 1e6, 2.5e7), False), ((1e12, 1e4, 1e4), True), ((1e4, 1e4, 1e9), True), ((1e4, 2e6, 1e4), True)],
)
@pytest.mark.parametrize("kind", ConstraintKind)
def test_a_precision_that_no_lidar_has_is_refused(information, refused, kind):
    bodies = drive([AHEAD] * 3)
    claim = replace(
        motion("a", *((2, 3) if kind is ConstraintKind.ODOMETRY else (0, 3)), np.array(AHEAD), kind),
        information=frozen(np.diag(information)),
    )
    bodies[-1:] = [claim] if kind is ConstraintKind.ODOMETRY else [bodies[-1], claim]
    reasons = list(refusals(bodies).values())
    assert bool(reasons) is refused
    assert not refused or "claims a standard deviation of" in reasons[0]


LEAST = {ConstraintKind.ODOMETRY: (0.013, 0.013, 0.003), ConstraintKind.CLOSURE: (0.03, 0.03, 0.006)}
"""Standard deviations of scan matching at its best, over a metre with 0.2 rad."""


@pytest.mark.parametrize("kind", ConstraintKind)
def test_no_claim_is_more_precise_than_scan_matching(kind):
    """In every direction: what is claimed beyond the least noise counts as the least noise, the rest stays."""
    rng, unit = np.random.default_rng(0), np.outer(LEAST[kind], LEAST[kind])
    changed = 0
    for _ in range(200):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        claimed = 10.0 ** rng.uniform(-3, 3, size=3)
        information = (axes * claimed) @ axes.T / unit
        claim = replace(motion("a", 0, 1, np.array((1.0, 0.0, 0.2)), kind), information=frozen(information))
        found = with_least_noise(claim)
        assert (found is claim) == (claimed.max() <= 1.01)
        np.testing.assert_allclose(
            np.diag(axes.T @ (found.information * unit) @ axes), np.minimum(claimed, 1.01), rtol=0.02
        )
        changed += found is not claim
    assert 50 < changed < 200


def test_what_robots_state_is_within_the_least_noise():
    """However many points a scan has."""
    for information in (np.zeros((3, 3)), np.diag((1e4, 1e4, 1e5)), 1e12 * np.eye(3)):
        for step in ((0.25, 0.0, 0.0), (0.0, 0.0, 0.25), (1.0, 0.3, -1.2)):
            tracked = TrackedScan(np.array((1.0, 2.0, 0.7)), information, None)
            stated = motion_information(np.array(step), tracked, WHEELS)
            claim = replace(motion("a", 0, 1, np.array(step)), information=frozen(stated))
            assert with_least_noise(claim) is claim
