"""The scans of a robot as it maps them: one rule for recordings, bags, live robots and programs."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fcslam.geometry.beams import beam_step
from fcslam.lidar.frontend import laser_index
from fcslam.lidar.own_body import Polygon, Sectors, is_in_polygon, is_in_sectors, look_into_sectors
from fcslam.lidar.scan import rays_of
from fcslam.records import Beams, CloudScan, LaserModel, LaserScan, Sweep, frozen
from fcslam.sources.contradictions import count_returns
from fcslam.wire.limits import MAXIMUM_LASER_RANGE_M
from fcslam.wire.quantisation import rounded


class MappedScans:
    """Prepares the scans of one robot for its map.

    Of a dense scan, every k-th beam is mapped; a laser's first scan decides k, as its beams may vary.
    """

    def __init__(self, ignore: Sectors = (), footprint: Polygon = ()) -> None:
        """Beams in the sectors ``ignore`` and returns within ``footprint`` are left out."""
        self._ignore, self._footprint = ignore, footprint
        self._lasers: list[LaserModel] = []
        self._last: tuple[LaserModel, int, LaserModel] | None = None
        """The laser of the previous scan, the stride of its mapped beams, and the laser with these beams."""

    def of(self, scan: LaserScan) -> LaserScan:
        """The scan as it is mapped.

        Its ranges, shape (mapped beams,), metres, are those of the wire, so that robot and cloud see the same numbers.
        No return is inf; an invalid range, or one at the maximum, is 0. All are 0 in a scan without any return, as of
        a covered laser: it does not show that the floor is free.
        """
        if self._last is None or scan.laser is not self._last[0]:
            step = beam_step(self._lasers[laser_index(self._lasers, scan.laser)].beams)
            self._last = scan.laser, step, _mapped_laser(scan.laser, step)
        _, step, laser = self._last
        ranges_m = scan.ranges_m[::step]
        if self._ignore:
            ranges_m = np.where(is_in_sectors(laser, self._ignore), np.float32(0.0), ranges_m)
        if self._footprint:
            origins, directions = rays_of(laser)  # the body moves with the laser
            points = origins + np.minimum(ranges_m, laser.max_range_m)[:, None] * directions
            ranges_m = np.where(is_in_polygon(points, self._footprint), np.float32(0.0), ranges_m)
        sweep = _mapped_sweep(scan.sweep, scan.laser.beam_count, step)
        ranges_m = rounded(ranges_m, laser.max_range_m)
        if not count_returns(ranges_m, laser.max_range_m):
            ranges_m = frozen(np.zeros_like(ranges_m), np.float32)
        return replace(scan, ranges_m=ranges_m, laser=laser, sweep=sweep)

    def cloud(self, scan: CloudScan) -> CloudScan:
        """The turn of a 3D LiDAR as it is mapped: without its points in the sectors and within the footprint."""
        if not (self._ignore or self._footprint):
            return scan
        xy = scan.points_m[:, :2].astype(np.float64)
        x, y = (xy - scan.origin_m[:2]).T
        own = look_into_sectors(np.degrees(np.arctan2(y, x)), self._ignore) | is_in_polygon(xy, self._footprint)
        points_m, times_s = frozen(scan.points_m[~own], np.float32), frozen(scan.times_s[~own], np.float32)
        return replace(scan, points_m=points_m, times_s=times_s)


@lru_cache(maxsize=256)  # the beams of some scanners vary from scan to scan
def _mapped_laser(laser: LaserModel, step: int) -> LaserModel:
    """The laser with every ``step``-th beam from its first on, and a maximum range that a packet can state."""
    count, first_rad, increment_rad = laser.beams
    every = laser.with_beams(Beams(-(-count // step), first_rad, step * increment_rad))
    return replace(every, max_range_m=min(every.max_range_m, MAXIMUM_LASER_RANGE_M))


def _mapped_sweep(sweep: Sweep | None, beam_count: int, step: int) -> Sweep | None:
    if sweep is None or step == 1:
        return sweep
    share = (beam_count - 1) // step * step / (beam_count - 1)
    return sweep._replace(last_s=sweep.first_s + share * (sweep.last_s - sweep.first_s))
