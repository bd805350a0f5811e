"""A robot is picked up and put down elsewhere in its building; its wheels never notice."""

from dataclasses import replace
from functools import lru_cache

from fcslam.geometry import se2
from fcslam.records import LaserScan, frozen
from tests import small_fleet


@lru_cache
def drives() -> list[list[LaserScan]]:
    """Of two robots in one building."""
    return [list(robot.scans()) for robot in small_fleet.draw(2, path_length_m=24.0, seed=2).robots]


def kidnapping() -> tuple[list[LaserScan], float]:
    """Scans of the one, then of the other, as wheels tell them that never left the floor; when it happened."""
    before, after = drives()[0][:80], drives()[1]
    return before + put_down(before[-1], after)[1:], before[-1].stamp


def put_down(last: LaserScan, after: list[LaserScan]) -> list[LaserScan]:
    """The scans of another drive as those of a robot that was carried there after its ``last`` scan."""
    start = after[0]
    return [
        replace(scan, stamp=last.stamp + scan.stamp - start.stamp + 0.3, T_odom_base=frozen(
            se2.compose(last.T_odom_base, se2.between(start.T_odom_base, scan.T_odom_base))
        ))
        for scan in after
    ]  # fmt: skip
