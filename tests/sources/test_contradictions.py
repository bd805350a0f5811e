"""Scans that say nothing or contradict the odometry are counted, and nothing else is."""

import numpy as np

from fcslam.records import LaserModel, LaserScan, frozen
from fcslam.sources import Fault
from fcslam.sources.contradictions import RepeatedScans, ScanWatch
from fcslam.sources.faults import Audit, FaultCount
from tests.lidar.worlds import corridor, drive, ranges, room

LASER = LaserModel(360, -np.pi, np.deg2rad(1.0), 20.0)
WAY = drive([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)], step_m=0.2)


def faults(poses, odometry, world=None, change=lambda _: None, stamps=None):
    """Those of a drive whose ranges ``change`` changes."""
    rng = np.random.default_rng(0)
    seen = ranges(poses, room() if world is None else world, LASER, 0.01, rng)
    change(seen)
    stamps = 0.2 * np.arange(len(poses)) if stamps is None else stamps
    scans = [
        LaserScan(stamp, frozen(row, np.float32), LASER, frozen(pose))
        for stamp, row, pose in zip(stamps.tolist(), seen, odometry, strict=True)
    ]
    audit, repeated = Audit(), RepeatedScans()
    watch = ScanWatch(audit)
    for number, scan in enumerate(scans, start=1):
        watch.add(number, scan)
    assert sum(not repeated.admits(scan) for scan in scans) == audit.faults()[Fault.REPEATED_SCAN].count
    return audit.faults()


def test_a_healthy_drive_and_a_robot_that_stands():
    still = np.repeat(WAY, 4, axis=0)
    found = faults(still, still)
    assert not found


def test_odometry_that_stands_still_while_the_robot_drives():
    found = faults(WAY, np.zeros_like(WAY))
    assert found[Fault.FROZEN_ODOMETRY].count > 0.5 * len(WAY)
    assert "scans that change while the odometry stands still" in str(found)


def test_odometry_that_freezes_on_the_way():
    odometry = WAY.copy()
    odometry[30:] = odometry[30]
    assert faults(WAY, odometry)[Fault.FROZEN_ODOMETRY].first_line > 31


def test_scans_that_a_driver_repeats_while_the_robot_drives():
    def freeze(seen):
        seen[40:60] = seen[40]

    found = faults(WAY, WAY, change=freeze)
    assert found[Fault.REPEATED_SCAN] == FaultCount(19, 42)


def test_scans_that_were_recorded_twice():
    def double(seen):
        seen[1::2] = seen[::2]

    twice = np.repeat(WAY, 2, axis=0)
    found = faults(twice, twice, change=double, stamps=0.2 * (np.arange(len(twice)) // 2))
    assert found[Fault.REPEATED_SCAN].count == len(WAY)


def test_a_robot_at_rest_may_see_the_same_again():
    def freeze(seen):
        seen[:] = seen[0]

    still = np.zeros((30, 3))
    for odometry in (still, np.full((30, 3), np.nan)):
        assert not faults(still, odometry, change=freeze)


def test_scans_of_a_covered_laser():
    def cover(seen):
        seen[40:50] = np.inf
        seen[50:60] = 0.0

    assert faults(WAY, WAY, change=cover).counts == {Fault.NO_RETURN: FaultCount(20, 41)}


def test_a_corridor_looks_the_same_from_everywhere():
    along = np.column_stack((0.2 * np.arange(60), np.zeros((60, 2))))
    assert not faults(along, along, corridor())
