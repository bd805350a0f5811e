"""Scans that say nothing or contradict the odometry are counted, and nothing else is."""

import numpy as np
import pytest

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


def replaced(rows, values):
    """A change of the ranges of these scans."""

    def change(seen):
        seen[rows] = values if np.isscalar(values) else seen[values]

    return change


ON_THE_WAY = np.vstack((WAY[:30], np.tile(WAY[30], (len(WAY) - 30, 1))))
"""Odometry that freezes."""
STILL = np.repeat(WAY, 4, axis=0)
TWICE = np.repeat(WAY, 2, axis=0)
ALONG = np.column_stack((0.2 * np.arange(60), np.zeros((60, 2))))
AT_REST, UNKNOWN = np.zeros((30, 3)), np.full((30, 3), np.nan)
TWICE_STAMPS = 0.2 * (np.arange(len(TWICE)) // 2)
ALIKE = {"change": replaced(slice(None), [0] * 30)}


@pytest.mark.parametrize(
    ("poses", "odometry", "options"),
    [(STILL, STILL, {}), (AT_REST, AT_REST, ALIKE), (AT_REST, UNKNOWN, ALIKE), (ALONG, ALONG, {"world": corridor()})],
    ids=["a drive with stops", "a robot at rest", "at rest without odometry", "a corridor, alike from everywhere"],
)
def test_a_healthy_robot_has_no_faults(poses, odometry, options):
    assert not faults(poses, odometry, **options)


@pytest.mark.parametrize(("odometry", "first"), [(np.zeros_like(WAY), 0), (ON_THE_WAY, 31)])
def test_odometry_that_stands_still_while_the_robot_drives(odometry, first):
    found = faults(WAY, odometry)
    assert found[Fault.FROZEN_ODOMETRY].count > 0.5 * (len(WAY) - first)
    assert found[Fault.FROZEN_ODOMETRY].first_line > first
    assert "scans that change while the odometry stands still" in str(found)


@pytest.mark.parametrize(
    ("poses", "options", "kind", "count"),
    [
        (WAY, {"change": replaced(slice(40, 60), [40] * 20)}, Fault.REPEATED_SCAN, FaultCount(19, 42)),
        (
            TWICE,
            {"change": replaced(slice(1, None, 2), slice(0, None, 2)), "stamps": TWICE_STAMPS},
            Fault.REPEATED_SCAN,
            FaultCount(len(WAY), 2),
        ),
        (WAY, {"change": replaced(slice(40, 50), np.inf)}, Fault.NO_RETURN, FaultCount(10, 41)),
        (WAY, {"change": replaced(slice(50, 60), 0.0)}, Fault.NO_RETURN, FaultCount(10, 51)),
    ],
    ids=["repeated by the driver", "recorded twice", "covered, without a return", "covered, at 0 m"],
)
def test_scans_that_say_nothing_are_counted(poses, options, kind, count):
    assert faults(poses, poses, **options).counts == {kind: count}
