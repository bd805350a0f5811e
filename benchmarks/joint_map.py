"""The fleet's map on every robot: how old the cells of others are, what it costs, and whether robots leave ghosts.

    python benchmarks/joint_map.py [--robots 3] [--path 60] [--seed 1]

A simulated fleet drives through one building at real time. Its LiDARs also see the other robots, as discs with a radius
of 0.25 m. Each robot is a `fcslam.Robot` with its own worker; all send to one `fcslam serve` on this machine. Once a
second, as the bridge to ROS does, each robot's map is read.

Age: from the moment at which the scan of another robot looked through a cell until the cell is known on this robot;
only cells that this robot did not see itself before, and that were
seen after the maps of all robots had joined. The end: the maps on the robots 5 s after the service was asked
for its result, against `map.pgm` of that result, which is that of `fcslam map` on the recordings
(`tests/service/test_worker.py`). The CPU of a scan is the mean of the thread that adds it. Robots that only send, to a
service of their own, drive at the same time and get the same scans half a period later. Ghosts: occupied cells of that
map within 0.25 m of where a robot drove.
"""

import tempfile
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
from faults import cloud, finalize

import fcslam
from fcslam.geometry import se2
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap

RADIUS_M = 0.25
FRESH_S = 5.0


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--path", type=float, default=60.0, help="of each robot, m")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    lidar = LidarSettings(beams=360, rate_hz=5.0)
    settings = SimulationSettings(robots=chosen.robots, path_length_m=chosen.path, lidar=lidar, camera=None)
    robots = simulate_fleet(settings, chosen.seed).robots
    ways = [(robot.stamps - robot.stamps[0], robot.T_building_base) for robot in robots]
    scans = []
    for k, robot in enumerate(robots):
        others = [way for j, way in enumerate(ways) if j != k]
        scans.append([
            replace(scan, stamp=at_s, ranges_m=_with_robots(scan, pose, [_at(other, at_s) for other in others]))
            for scan, pose, at_s in zip(robot.scans(), robot.T_building_base, ways[k][0].tolist(), strict=True)
        ])  # fmt: skip
    with ExitStack() as opened:
        port, other_port = (
            opened.enter_context(cloud(Path(opened.enter_context(tempfile.TemporaryDirectory()))))[1] for _ in range(2)
        )
        live, apart = (
            [
                opened.enter_context(
                    closing(fcslam.Robot(robot.name, server=f"http://127.0.0.1:{at}", own_map=own_map))
                )
                for robot in robots
            ]
            for at, own_map in ((port, True), (other_port, False))
        )
        samples: list[list[tuple[float, OccupancyMap]]] = [[] for _ in robots]
        joined_s, joins = 0.0, 0
        began_s = time.monotonic()
        threads, costs = _started(live, scans)
        others_drive, alone = _started(apart, scans, 0.5 / lidar.rate_hz)
        while any(thread.is_alive() for thread in threads):
            time.sleep(1.0)
            if (count := sum(len(robot.fleet.news) for robot in live)) > joins:
                joined_s, joins = time.monotonic() - began_s, count
            for k, robot in enumerate(live):
                if (joint := robot.joint_map()) is not None:
                    samples[k].append((time.monotonic() - began_s, joint))
        duration_s = time.monotonic() - began_s
        for thread in others_drive:
            thread.join()
        for robot in live:
            robot.finish(60.0)
        received = [robot.fleet.received_bytes for robot in live]
        run = fcslam.open_run(finalize(port))
        time.sleep(5.0)
        final = run.maps[0]
        ends = [robot.joint_map() or final for robot in live]
        same = [_difference(end, final) for end in ends]
        news = [robot.fleet.news for robot in live]
    paths = [run.trajectories[robot.name] for robot in robots]
    ages = [_ages(samples[k], paths, scans, k, joined_s) for k in range(len(robots))]
    report.table(
        "Each robot",
        {"": "s", "cells, n": ",d", "age 50 %, s": ".1f", "age 95 %, s": ".1f", "kB/s down": ".1f",
         "differ at the end": ",d", "known cells": ",d", "CPU of a scan, ms": ".2f", "only sends, ms": ".2f"},
        [
            (robot.name, len(ages[k]), *np.percentile(ages[k], (50, 95)), received[k] / 1e3 / duration_s, same[k],
             int((final.cells > 0).sum()), 1e3 * np.mean(costs[k]), 1e3 * np.mean(alone[k]))
            for k, robot in enumerate(robots)
        ],
    )  # fmt: skip
    everywhere = np.concatenate(ages)
    report.say(
        f"On all robots, {np.mean(everywhere <= FRESH_S):.1%} of {len(everywhere):,} cells come within {FRESH_S:g} s."
    )
    more = np.mean(np.concatenate(costs)) / np.mean(np.concatenate(alone)) - 1.0
    report.say(f"With the joint map and the others, a scan takes {more:+.1%} of CPU.")
    report.say(f"{duration_s:.0f} s of driving; ghosts: {_ghosts(run, final)} occupied cells where a robot drove.")
    report.say(f"Events on the first robot: {'; '.join(news[0])}.")
    report.write()


def _with_robots(scan, pose, others):
    """Ranges of a scan at a true pose, with other robots as discs; a range at the maximum is no return."""
    laser = scan.laser
    T_building_laser = se2.compose(pose, np.array(laser.T_base_laser))
    ranges = np.array(scan.ranges_m, np.float64)
    directions = laser.angles_rad() + T_building_laser[2]
    rays = np.stack((np.cos(directions), np.sin(directions)), axis=-1)
    for other in others:
        centre = other[:2] - T_building_laser[:2]
        along = rays @ centre
        half = RADIUS_M**2 - (centre @ centre - along**2)
        hit = along - np.sqrt(np.maximum(half, 0.0))
        ranges = np.where((half > 0.0) & (hit > 0.05) & (hit < np.where(ranges > 0.0, ranges, np.inf)), hit, ranges)
    return ranges.astype(np.float32)


def _at(way, at_s):
    """The pose of a robot at a moment; it stands at the ends of its way."""
    return way[1][min(max(int(np.searchsorted(way[0], at_s)), 0), len(way[0]) - 1)]


def _started(robots, scans, after_s=0.0):
    """Threads in which robots add their scans at real time, and the CPU time of each scan, as it grows."""
    began_s, costs = time.monotonic() + after_s, [[] for _ in robots]
    threads = [
        threading.Thread(target=_drive, args=(robot, some, began_s, taken))
        for robot, some, taken in zip(robots, scans, costs, strict=True)
    ]
    for thread in threads:
        thread.start()
    return threads, costs


def _drive(robot, scans, began_s, costs):
    for scan in scans:
        time.sleep(max(0.0, began_s + scan.stamp - time.monotonic()))
        before = time.thread_time()
        robot.add(scan)
        costs.append(time.thread_time() - before)


def _difference(first: OccupancyMap, second: OccupancyMap) -> int:
    """Cells of either map that differ in the other; cells outside of a map are unknown."""
    side = first.resolution_m
    corners = [np.round(np.array(one.origin_xy) / side).astype(int) for one in (first, second)]
    low = np.min(corners, axis=0)
    high = np.max(
        [corner + one.cells.shape[::-1] for corner, one in zip(corners, (first, second), strict=True)], axis=0
    )
    wide = np.zeros((2, *(high - low)[::-1]), np.uint8)
    for k, (corner, one) in enumerate(zip(corners, (first, second), strict=True)):
        x, y = corner - low
        wide[k, y : y + one.cells.shape[0], x : x + one.cells.shape[1]] = one.cells
    return int((wide[0] != wide[1]).sum())


def _ages(samples, paths, scans, number, joined_s):
    """Ages of the cells that a robot has from others, s; of those that they saw once all maps were joined."""
    first: dict[int, dict[tuple[int, int], float]] = {}
    for k, (path, own) in enumerate(zip(paths, scans, strict=True)):
        seen: dict[tuple[int, int], float] = {}
        by_stamp = {scan.stamp: scan for scan in own}
        for stamp, pose in zip(path.stamps.tolist(), path.T_map_base, strict=True):
            scan = by_stamp[min(by_stamp, key=lambda each, stamp=stamp: abs(each - stamp))]
            grid = cast([Casting(scan.ranges_m, scan.laser, pose)], OccupancyConfig())
            column, row = np.round(np.array(grid.origin_xy) / grid.resolution_m).astype(int)
            for y, x in zip(*np.nonzero(grid.passes), strict=True):
                seen.setdefault((row + int(y), column + int(x)), stamp)
        first[k] = seen
    others: dict[tuple[int, int], float] = {}
    for k, seen in first.items():
        if k != number:
            for cell, at_s in seen.items():
                others[cell] = min(others.get(cell, np.inf), at_s)
    ages, known = [], set()
    for at_s, joint in samples:
        column, row = np.round(np.array(joint.origin_xy) / joint.resolution_m).astype(int)
        for y, x in zip(*np.nonzero(joint.cells), strict=True):
            cell = (row + int(y), column + int(x))
            if cell in known:
                continue
            known.add(cell)
            seen_s = others.get(cell, -np.inf)
            if joined_s < seen_s < at_s and first[number].get(cell, np.inf) > at_s:
                ages.append(at_s - seen_s)
    return ages or [np.nan]


def _ghosts(run, final: OccupancyMap) -> int:
    rows, columns = np.nonzero(final.cells == Occupancy.OCCUPIED)
    cells = np.array(final.origin_xy) + final.resolution_m * (np.stack((columns, rows), axis=-1) + 0.5)
    near = np.zeros(len(cells), bool)
    for path in run.trajectories.values():
        for x, y, _ in path.T_map_base:
            near |= np.hypot(*(cells - (x, y)).T) < RADIUS_M
    return int(near.sum())


if __name__ == "__main__":
    main()
