"""Which odometry a scan gets: laws on drawn streams, and every way in which a stream may be odd."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.sources.bags.camera import ImageMessage
from fcslam.sources.bags.messages import Beams, OdometryReading, ScanMessage
from fcslam.sources.bags.pairing import MAX_GAP_S, OdometryPairing, PosedScan
from fcslam.sources.faults import Fault


def scan(stamp):
    return ScanMessage(stamp, "laser", Beams(2, 0.0, 0.1), 0.0, 10.0, np.ones(2, np.float32))


def reading(stamp, pose=None):
    return OdometryReading(stamp, pose or (2.0 * stamp, -stamp, 0.05 * stamp), "base", "odom")


def paired(items):
    """The items with their poses, as a pass over a bag gives them."""
    pairing = OdometryPairing()
    for number, item in items:
        yield from pairing.add(number, item)
    yield from pairing.flush()


def run(items):
    """The scans that come out, in order; checks that nothing is lost and odometry keeps its order."""
    out = list(paired(enumerate(items, start=1)))
    assert [number for number, _ in out] == list(range(1, len(items) + 1))
    return [entry for _, entry in out if isinstance(entry, PosedScan)]


def poses(items):
    return [entry.T_odom_base for entry in run(items)]


def assert_on_the_line(pose, stamp):
    """Where ``reading`` puts the robot at ``stamp``."""
    np.testing.assert_allclose(pose[:2], (2.0 * stamp, -stamp), atol=1e-9)
    assert math.remainder(pose[2] - 0.05 * stamp, math.tau) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("late_by", [1, 2, 3])
def test_a_reading_that_is_recorded_after_later_ones_changes_nothing(late_by):
    """As over a network that changes their order: the scans lie on the line, and none is beyond the odometry."""
    stamps = [0.05 * k for k in range(200)]
    order = sorted(range(200), key=lambda k: k + (late_by + 0.5) * (k % 10 == 5))
    said = [(stamps[place], 0, reading(stamps[k])) for place, k in enumerate(order)]
    said += [(0.2 * k + 0.33, 1, scan(0.2 * k + 0.33)) for k in range(40)]
    said.sort(key=lambda entry: entry[:2])
    for entry in run([item for *_, item in said]):
        assert entry.fault is None
        assert_on_the_line(entry.T_odom_base, entry.scan.stamp)


def test_a_clock_of_the_odometry_that_steps_back_for_good_is_followed():
    stamps = [0.05 * k for k in range(100)] + [4.5 + 0.05 * k for k in range(40)]
    said = [reading(stamp, (0.01 * k, 0.0, 0.0)) for k, stamp in enumerate(stamps)]
    (pose,) = poses([*said, scan(stamps[-1])])
    assert pose[0] == pytest.approx(0.01 * (len(stamps) - 1))


times = st.integers(0, 40_000).map(lambda ms: ms / 1000)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.lists(times, min_size=2, max_size=30, unique=True), st.lists(times, max_size=20), st.floats(0.0, 3.0))
def test_a_robot_on_a_line_is_where_the_line_says(readings, scans, late_s):
    """Whatever comes when: odometry by its time, scans late by up to 3 s."""
    said = [(stamp, 0, reading(stamp)) for stamp in readings] + [(stamp + late_s, 1, scan(stamp)) for stamp in scans]
    said.sort(key=lambda entry: entry[:2])
    for entry in run([item for *_, item in said]):
        stamp = entry.scan.stamp
        if min(readings) <= stamp <= max(readings):
            assert_on_the_line(entry.T_odom_base, stamp)
            before = max(t for t in readings if t <= stamp)
            after = min(t for t in readings if t >= stamp)
            assert (entry.fault is Fault.ODOMETRY_GAP) == (after - before > MAX_GAP_S and stamp not in (before, after))
        else:
            nearest = min(readings, key=lambda t: abs(t - stamp))
            held = abs(nearest - stamp) <= MAX_GAP_S
            assert entry.fault is (Fault.HELD_ODOMETRY if held else Fault.NO_ODOMETRY)
            assert not held or entry.T_odom_base == reading(nearest).T_odom_base


@settings(deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-3.0, 3.0), st.floats(0.01, 0.99))
def test_headings_turn_the_shortest_way(start, turn, share):
    end = math.remainder(start + turn, math.tau)
    ((_, _, theta),) = poses([reading(0.0, (0, 0, start)), scan(share), reading(1.0, (0, 0, end))])
    assert abs(math.remainder(theta - start - share * turn, math.tau)) < 1e-9


def test_odometry_that_comes_late_is_waited_for():
    items = [reading(0.0), *(scan(0.1 * k) for k in range(1, 10)), *(reading(0.1 * k) for k in range(1, 12))]
    for pose, k in zip(poses(items), range(1, 10), strict=True):
        assert_on_the_line(pose, 0.1 * k)


def test_equal_stamps_take_the_reading_beside_them():
    items = [reading(1.0, (1, 0, 0)), scan(1.0), reading(1.0, (2, 0, 0)), scan(1.0), reading(1.0, (3, 0, 0))]
    assert poses(items) == [(1, 0, 0), (2, 0, 0)]


def test_a_scan_that_waits_when_the_clock_steps_back_takes_the_nearest_reading():
    items = [reading(9.0), scan(9.2), reading(5.0), reading(5.5), scan(5.25), reading(9.5)]
    held, between = run(items)
    assert (held.T_odom_base, held.fault) == (reading(9.0).T_odom_base, Fault.HELD_ODOMETRY)
    assert_on_the_line(between.T_odom_base, 5.25)


def test_one_scan_far_ahead_does_not_stop_the_others():
    items = [reading(0.0), scan(9e9)]
    for k in range(1, 3000):
        items += [scan(0.1 * k - 0.05), reading(0.1 * k)]
    first, *others = run(items)
    assert first.fault is Fault.NO_ODOMETRY
    assert {entry.fault for entry in others} == {None}
    assert all(a.scan.stamp < b.scan.stamp for a, b in pairwise(others))


def test_an_image_of_the_same_clock_waits_for_its_odometry():
    pairing = OdometryPairing()
    items = [reading(1.0), ImageMessage(1.15, b""), scan(1.0), scan(1.05), reading(1.2)]
    out = [entry for item in items for _, entry in pairing.add(1, item)]
    assert_on_the_line(out[1].T_odom_base, 1.15)


def test_what_waits_is_bounded():
    """Scans whose clock is ahead for good leave the queue long before the recording ends."""

    def items():
        for k in range(5000):
            fed.append(k)
            yield k, scan(1e6 + k) if k % 2 else reading(0.1 * k)

    fed: list[int] = []
    behind = [len(fed) - number for number, _ in paired(items()) if len(fed) < 5000]
    assert max(behind) <= 1010
