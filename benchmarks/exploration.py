"""Three robots explore a building: frontiers assigned by fcslam against each robot taking its nearest frontier.

    python benchmarks/exploration.py [--seeds 10] [--offices 2] [--robots 3]

The robots start side by side in a building of the simulator. They move at 0.5 m/s along shortest paths, and see 12 m
far in all directions. The radius of a robot is 0.35 m. The joint map has cells of 0.1 m; motion, map and communication
have no errors. Time: until 95 % of the area that a robot can reach is seen, at most an hour.

Nearest: each robot drives to the frontier that is nearest to it, until it is there or the frontier is gone. Own: the
same, but no robot takes a frontier that another one has. Assigned: `fcslam.maps.exploration.Explorer`, asked every 5 s
and when a robot has no goal, as on live robots. The weights of `Explorer` were chosen on the seeds 100 to 108 of the
default kind.
"""

import common
import numpy as np
from scipy.ndimage import label

from fcslam.compiled import njit
from fcslam.lab.simulation.drivable_space import obstacle_cells
from fcslam.lab.simulation.floorplan import draw_floor_plan
from fcslam.lab.simulation.options import Building
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.exploration import REACHED_M, Explorer
from fcslam.maps.frontiers import frontiers, passable_cells, path_lengths, search_grid, start_cells
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap

FREE, OCCUPIED = int(Occupancy.FREE), int(Occupancy.OCCUPIED)
RADIUS_M = OccupancyConfig().robot_radius_m
SIDE_M, RANGE_M, SPEED_MPS, SHARE, EVERY_S, LONGEST_S = 0.1, 12.0, 0.5, 0.95, 5, 3600


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=10, help="buildings of the default kind, 22 m by 17 m")
    parser.add_argument("--offices", type=int, default=2, help="offices, 60 m by 40 m")
    parser.add_argument("--robots", type=int, default=3)
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    for kind, count in ((Building.DEFAULT, chosen.seeds), (Building.OFFICE, chosen.offices)):
        if count:
            _compare(report, kind, count, chosen.robots)
    report.write()


def _compare(report, kind, count, robots):
    rows = []
    for seed in range(count):
        walls = _walls(kind, seed)
        starts = _starts(walls, robots, seed)
        area = SIDE_M**2 * _reachable(walls, starts[0]).sum()
        rows.append((f"building {seed}", area, *(_explore(walls, starts, way()) for way in (Nearest, Own, Assigned))))
    rows.append(("all", *np.sum([row[1:] for row in rows], axis=0)))
    report.table(
        f"Time until 95 % are seen: {kind}",
        {"": "s", "area, m2": ".0f", "nearest, s": ".0f", "own, s": ".0f", "assigned, s": ".0f",
         "less than nearest, %": ".0f", "less than own, %": ".0f"},
        [(*row, 100.0 * (1.0 - row[4] / row[2]), 100.0 * (1.0 - row[4] / row[3])) for row in rows],
    )  # fmt: skip


class Nearest:
    """Each robot takes the frontier nearest to it, and keeps it until it is there or the frontier is gone."""

    is_exclusive = False
    every_s = LONGEST_S

    def __init__(self):
        self._goals, self._visited = {}, []

    def assign(self, found, robots):
        for robot, at in robots.items():
            if robot in self._goals and np.hypot(*np.subtract(self._goals[robot], at)) <= REACHED_M:
                self._visited.append(self._goals.pop(robot))
        left = [one for one in found if all(np.hypot(*np.subtract(one.point, seen)) > REACHED_M
                                            for seen in self._visited)]  # fmt: skip
        result = {}
        for k, robot in enumerate(robots):
            kept = [one for one in left if robot in self._goals
                    and np.hypot(*np.subtract(one.point, self._goals[robot])) <= 1.0]  # fmt: skip
            free = [one for one in left if not (self.is_exclusive and one in result.values())]
            best = min(kept or free or left, key=lambda one, k=k: one.distances_m[k], default=None)
            if best is not None and np.isfinite(best.distances_m[k]):
                result[robot] = best
        self._goals = {robot: one.point for robot, one in result.items()}
        return result


class Own(Nearest):
    is_exclusive = True


class Assigned(Explorer):
    every_s = EVERY_S


def _explore(walls, starts, policy):
    """Seconds until the robots have seen enough."""
    known = np.zeros(walls.shape, np.uint8)
    area, robots, ways = _reachable(walls, starts[0]), np.array(starts), [[] for _ in starts]
    for now_s in range(LONGEST_S):
        for x, y in robots:
            _look(walls, known, x, y)
        if (known[area] > 0).mean() >= SHARE:
            break
        if now_s % policy.every_s == 0 or _is_done(known, ways, now_s):
            ways = _ways(OccupancyMap(known, SIDE_M, (0.0, 0.0)), robots, policy)
        robots = np.array([_moved(at, way) for at, way in zip(robots, ways, strict=True)])
    return now_s


def _ways(occupancy, robots, policy):
    """The path of each robot to its frontier, points (N, 2); empty without one."""
    found = frontiers(occupancy, robots, RADIUS_M)
    goals = policy.assign(found, {k: tuple(at) for k, at in enumerate(robots.tolist())})
    free, occupied, side_m, origin = search_grid(occupancy)
    passable = passable_cells(free, occupied, side_m, RADIUS_M)
    lengths = path_lengths(passable, start_cells(passable, robots, side_m, origin), side_m)
    ways = []
    for k, field in enumerate(lengths):
        way = []
        if k in goals:
            cell = tuple(np.floor((np.array(goals[k].point) - origin) / side_m).astype(int)[::-1])
            while cell is not None:
                way.append(np.array(origin) + side_m * (np.array(cell[::-1]) + 0.5))
                row, column = (max(at - 1, 0) for at in cell)
                window = field[row : row + 3, column : column + 3]
                lowest = np.unravel_index(np.argmin(window), window.shape)
                following = row + lowest[0], column + lowest[1]
                cell = following if field[following] < field[cell] else None
        ways.append(way[::-1])
    return ways


def _moved(at, way):
    left_m = SPEED_MPS
    while way and left_m > 0.0:
        apart_m = np.hypot(*(way[0] - at))
        if apart_m > left_m:
            return at + left_m / apart_m * (way[0] - at)
        at, left_m = way.pop(0), left_m - apart_m
    return at


def _is_done(known, ways, now_s):
    """Whether a robot needs a frontier; robots without one ask every other second."""
    return any(_is_seen(known, way[-1]) if way else now_s % 2 == 0 for way in ways)


def _is_seen(known, point):
    """Whether a frontier is gone: nothing is unknown near its point."""
    row, column = (int(edge / SIDE_M) for edge in point[::-1])
    return (known[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] > 0).all()


def _walls(kind, seed):
    fine = obstacle_cells(draw_floor_plan(np.random.default_rng(seed), kind))  # cells of 0.05 m
    height, width = (-(-size // 2) * 2 for size in fine.shape)
    whole = np.ones((height, width), bool)
    whole[: fine.shape[0], : fine.shape[1]] = fine
    return whole.reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3))


def _passable(walls):
    return passable_cells(~walls, walls, SIDE_M, RADIUS_M)


def _reachable(walls, start):
    parts, _ = label(_passable(walls), np.ones((3, 3)))
    column, row = (int(edge / SIDE_M) for edge in start)
    return parts == parts[row, column]


def _starts(walls, count, seed):
    """Places side by side, 0.7 m apart, in the largest part of the building, shape (count, 2)."""
    parts, _ = label(_passable(walls), np.ones((3, 3)))
    cells = np.argwhere(parts == 1 + np.argmax(np.bincount(parts.ravel())[1:]))
    first = cells[np.random.default_rng(seed).integers(len(cells))]
    taken = []
    for cell in cells[np.argsort(np.hypot(*(cells - first).T))]:
        if len(taken) < count and all(SIDE_M * np.hypot(*(cell - other)) > 0.7 for other in taken):
            taken.append(cell)
    return SIDE_M * (np.array(taken)[:, ::-1] + 0.5)


@njit
def _look(walls, known, x, y):
    for beam in range(720):
        cos, sin = np.cos(beam * np.pi / 360.0), np.sin(beam * np.pi / 360.0)
        for step in range(int(2.0 * RANGE_M / SIDE_M)):
            row, column = int(y / SIDE_M + 0.5 * step * sin), int(x / SIDE_M + 0.5 * step * cos)
            if not (0 <= row < walls.shape[0] and 0 <= column < walls.shape[1]):
                break
            known[row, column] = OCCUPIED if walls[row, column] else FREE
            if walls[row, column]:
                break


if __name__ == "__main__":
    main()
