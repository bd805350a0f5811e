"""Checks joins of runs by a search that knows nothing of places and closures. No benchmark itself.

The whole map of one run, made alone, is laid on that of the other at every position and heading. The runner-up is the
best pose at least 3 m or 45 degrees off the best; a score close to the best's means that the search cannot tell.
"""

import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
import yaml
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.runs import Run, open_run

CELL_M = 0.1
COARSE_M = 0.2
HEADING_STEP_RAD = np.radians(2.0)
WELL_INSIDE_M = 0.4
APART_M, APART_RAD = 3.0, np.radians(45.0)
WRONG_M, WRONG_RAD = 0.5, np.radians(10.0)
PAIR_COLUMNS = {"run": "", "run ": "", "joined": "", "closures": "", "search: best": ".2f", "runner-up": ".2f",
                "off by, m": ".2f", "off by, deg": ".1f", "right": ""}  # fmt: skip

FloatArray = NDArray[np.float64]


class Plan(NamedTuple):
    """A map as cells; rows go with y."""

    walls: NDArray[np.bool_]
    free: NDArray[np.bool_]
    cell_m: float
    corner: FloatArray
    """Of cell (0, 0), in the map's coordinate frame."""

    def points(self, cells: NDArray[np.bool_]) -> FloatArray:
        """Centres of the cells that are true, shape (N, 2)."""
        return (np.argwhere(cells)[:, ::-1] + 0.5) * self.cell_m + self.corner

    def coarser(self, cell_m: float) -> "Plan":
        """Larger cells: a wall where there is one in it, free where something is free and no wall is."""
        shape = np.ceil(np.array(self.walls.shape) * self.cell_m / cell_m).astype(int) + 1
        walls, free = np.zeros(shape, bool), np.zeros(shape, bool)
        for into, cells in ((walls, self.walls), (free, self.free)):
            into[tuple(np.floor((self.points(cells) - self.corner) / cell_m).astype(int)[:, ::-1].T)] = True
        return Plan(walls, free & ~walls, cell_m, self.corner)


class Found(NamedTuple):
    """A pose of one plan in another, and how well it fits: 1 if every wall lies on a wall and nothing contradicts."""

    score: float
    T_target_query: FloatArray


def own_plan(folder: Path, map_index: int) -> Plan:
    """A map of a run folder, in cells of ``CELL_M``."""
    import cv2

    stem = "map" if map_index == 0 else f"map_{map_index}"
    pixels = cv2.imread(str(folder / f"{stem}.pgm"), cv2.IMREAD_UNCHANGED)[::-1]
    header = yaml.safe_load((folder / f"{stem}.yaml").read_text(encoding="utf-8"))
    plan = Plan(pixels == 0, pixels == 254, header["resolution"], np.array(header["origin"][:2]))
    return plan.coarser(CELL_M)


def fields(target: Plan, sigma_m: float) -> tuple[FloatArray, FloatArray]:
    """What a wall of the query earns in each cell of the target, and what its free space costs there."""
    from scipy.ndimage import distance_transform_edt

    distance_m = distance_transform_edt(~target.walls) * target.cell_m
    near = np.exp(-0.5 * (distance_m / sigma_m) ** 2)
    return near - 0.5 * (target.free & (distance_m > WELL_INSIDE_M)), target.walls.astype(np.float64)


def search(query: Plan, target: Plan) -> list[Found]:
    """The best pose of ``query`` in ``target`` and the runner-up."""
    ranked = sorted(coarse_poses(query, target), key=lambda found: -found.score)
    distinct: list[Found] = []
    for found in ranked:
        if all(apart(found, other, 1.0, np.radians(10.0)) for other in distinct):
            distinct.append(found)
        if len(distinct) == 12:
            break
    refined = sorted((refine(query, target, found) for found in distinct), key=lambda found: -found.score)
    return [refined[0], next(found for found in refined if apart(found, refined[0], APART_M, APART_RAD))]


def apart(one: Found, other: Found, distance_m: float, angle_rad: float) -> bool:
    gap = se2.between(one.T_target_query, other.T_target_query)
    return bool(np.hypot(gap[0], gap[1]) > distance_m or abs(gap[2]) > angle_rad)


def coarse_poses(query: Plan, target: Plan) -> Iterator[Found]:
    """For each heading the best positions, by correlation; poses are those of the query's middle."""
    from scipy import fft

    query, target = query.coarser(COARSE_M), target.coarser(COARSE_M)
    walls, free, _ = centred(query)
    reach = int(np.ceil(np.hypot(*np.concatenate([walls, free]).T).max() / COARSE_M)) + 1
    shape = [fft.next_fast_len(size + 2 * reach, real=True) for size in target.walls.shape]
    earned, costs = (fft.rfft2(field, shape) for field in fields(target, COARSE_M))
    for heading in np.arange(0.0, 2.0 * np.pi, HEADING_STEP_RAD):
        turn = np.array([0.0, 0.0, heading])
        wall_image, free_image = (image(se2.transform(turn, points), reach, shape) for points in (walls, free))
        scores = fft.irfft2(earned * np.conj(fft.rfft2(wall_image)) - costs * np.conj(fft.rfft2(free_image)), shape)
        scores = np.roll(scores, (reach, reach), (0, 1))[: target.walls.shape[0], : target.walls.shape[1]]
        for _ in range(4):
            row, column = np.unravel_index(np.argmax(scores), scores.shape)
            xy = (np.array([column, row]) + 0.5) * COARSE_M + target.corner
            yield Found(float(scores[row, column]), np.array([*xy, heading]))
            scores[max(0, row - 5) : row + 6, max(0, column - 5) : column + 6] = -np.inf


def centred(plan: Plan) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Walls and free space around the walls' middle, and that middle."""
    walls = plan.points(plan.walls)
    middle = walls.mean(axis=0)
    return walls - middle, plan.points(plan.free) - middle, middle


def image(points: FloatArray, reach: int, shape: list[int]) -> FloatArray:
    """Shares of the points in cells around the middle, in the corner of an image of this shape."""
    cells = np.floor(points / COARSE_M).astype(int) + reach
    counts = np.zeros(shape)
    np.add.at(counts, (cells[:, 1], cells[:, 0]), 1.0 / len(points))
    return counts


def refine(query: Plan, target: Plan, start: Found) -> Found:
    """Climb from a pose of the query's middle; the pose that comes back is that of the query's own origin."""
    from scipy.optimize import minimize

    walls, free, middle = centred(query)
    free = free[::7]
    pose = start.T_target_query
    for sigma_m in (0.3, 0.15):
        earned, costs = fields(target, sigma_m)

        def loss(pose: FloatArray, earned: FloatArray = earned, costs: FloatArray = costs) -> float:
            return mean_at(costs, free, pose, target) - mean_at(earned, walls, pose, target)

        simplex = pose + np.array([(0, 0, 0), (0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.02)])
        found = minimize(loss, pose, method="Nelder-Mead", options={"initial_simplex": simplex, "maxiter": 200})
        pose = found.x
    return Found(-float(found.fun), se2.compose(pose, np.array([*-middle, 0.0])))


def mean_at(field: FloatArray, points: FloatArray, pose: FloatArray, target: Plan) -> float:
    """Mean of the field where the points lie; 0 outside."""
    from scipy.ndimage import map_coordinates

    cells = (se2.transform(pose, points) - target.corner) / target.cell_m - 0.5
    return float(map_coordinates(field, cells.T[::-1], order=1, cval=0.0).mean())


class Placed(NamedTuple):
    """A run as mapped alone, and where the joint run put it."""

    plan: Plan
    map_index: int
    T_map_alone: FloatArray
    middle: FloatArray
    """Mean position of the robot in its own map, shape (1, 2)."""


def placed(alone: Run, together: Run, folder: Path) -> dict[str, Placed]:
    """Every run, by the best fit of its two trajectories on each other."""
    joint = together.trajectories
    runs = {}
    for own in alone.trajectories.values():
        other = joint[own.robot]
        T_map_alone = n_point_alignment(other.T_map_base[:, :2], own.T_map_base[:, :2])
        plan = own_plan(folder, own.map_index)
        runs[own.robot] = Placed(plan, other.map_index, T_map_alone, own.T_map_base[:, :2].mean(axis=0, keepdims=True))
    return runs


class Together(NamedTuple):
    """Runs mapped together and each alone."""

    run: Run
    runs: dict[str, Placed]
    plan: Plan
    """The largest joint map."""
    cost: common.Cost
    """Of mapping them together."""


def map_together(logs: Sequence[Path]) -> Together:
    """Map logs together and each alone, by the real command."""
    with tempfile.TemporaryDirectory() as place:
        joint, alone = Path(place) / "joint", Path(place) / "alone"
        cost = common.run_fcslam("map", *logs, "--output", joint)
        common.run_fcslam("map", *logs, "--config", "fleet.join_maps=false", "--output", alone)
        run = open_run(joint)
        return Together(run, placed(open_run(alone), run, alone), own_plan(joint, 0), cost)


def pair_rows(runs: dict[str, Placed], together: Run) -> list[tuple]:
    """For each pair of runs: what the joint run says, what the search says, and whether they agree."""
    accepted = Counter(
        frozenset((c.robot_i, c.robot_j)) for c in together.closures if c.status.value == "accepted"
    )  # fmt: skip
    rows = []
    for a, b in combinations(runs, 2):
        one, other = runs[a], runs[b]
        best, second = search(other.plan, one.plan)
        joined = one.map_index == other.map_index
        gap_m = gap_deg = np.nan
        if joined:
            T_a_b = se2.compose(se2.inverse(one.T_map_alone), other.T_map_alone)
            places = [se2.transform(pose, other.middle) for pose in (T_a_b, best.T_target_query)]
            gap_m = float(np.linalg.norm(places[0] - places[1]))
            gap_deg = float(np.degrees(abs(se2.between(T_a_b, best.T_target_query)[2])))
        right = gap_m < WRONG_M and gap_deg < np.degrees(WRONG_RAD)
        verdict = "-" if not joined else "yes" if right else "NO"
        counts = accepted[frozenset((a, b))], best.score, second.score
        rows.append((a, b, "yes" if joined else "no", *counts, gap_m, gap_deg, verdict))
    return rows
