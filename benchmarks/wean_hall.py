"""Five real runs in one building, mapped together and laid on a picture of the building's reference map.

    FCSLAM_DATA=/path/to/data python benchmarks/wean_hall.py

Wean Hall, Carnegie Mellon University (course data of 16-833). Its corridor repeats itself every 12.2 m, so a join may
be wrong and look right. Every join is checked by a search that knows nothing of places and closures: the whole map of
one run, made alone, is laid on that of the other at every position and heading. The runner-up is the best pose at least
3 m or 45 degrees off the best; a score close to the best's means that the search cannot tell.

The picture has walls half a metre thick and no scale: cells of the size are taken in which the largest map fits best.
Writes docs/images/wean-hall.png as well.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
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

RUNS = tuple(f"robotdata{number}" for number in range(1, 6))
LOGS = tuple(f"wean-hall/{run}.log.gz" for run in RUNS)
PICTURE = "wean-hall/wean-map.gif"
FRAME_PX = (17, 4, 2, 2)
"""The window's frame in the picture: top, bottom, left, right."""
FIGURE = common.REPOSITORY / "docs" / "images" / "wean-hall.png"

PAPER = (236, 239, 241)
"""Red, green, blue."""

CELL_M = 0.1
COARSE_M = 0.2
SCALES_M = (0.088, 0.091, 0.094, 0.097, 0.1, 0.103)
HEADING_STEP_RAD = np.radians(2.0)
NEAR_M = 0.3
WELL_INSIDE_M = 0.4
APART_M, APART_RAD = 3.0, np.radians(45.0)
WRONG_M, WRONG_RAD = 0.5, np.radians(10.0)

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


def reference_plan(picture: Path, cell_m: float) -> Plan:
    """The picture's map: walls are the cells of black that face white, since black is as thick as it was drawn."""
    import cv2
    from scipy.ndimage import binary_dilation

    top, bottom, left, right = FRAME_PX
    pixels = cv2.imread(str(picture), cv2.IMREAD_COLOR)[top:-bottom, left:-right][::-1].astype(int)
    gray = pixels.max(axis=2) - pixels.min(axis=2) < 40
    white, black = gray & (pixels[..., 1] > 235), gray & (pixels[..., 1] < 60)
    return Plan(black & binary_dilation(white, np.ones((3, 3))), white, cell_m, np.zeros(2))


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


def near_share(points: FloatArray, pose: FloatArray, target: Plan) -> float:
    """Share of the points within ``NEAR_M`` of a wall of the target."""
    from scipy.ndimage import distance_transform_edt

    near = (distance_transform_edt(~target.walls) * target.cell_m <= NEAR_M).astype(np.float64)
    return mean_at(near, points, pose, target)


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


def scaled_reference(picture: Path, plan: Plan) -> tuple[Plan, FloatArray]:
    """The reference map in the scale in which ``plan`` fits best, and T_reference_map."""
    fits = []
    for cell_m in SCALES_M:
        target = reference_plan(picture, cell_m)
        best, _ = search(plan, target)
        fits.append((best.score, cell_m, target, best.T_target_query))
    _, _, target, pose = max(fits, key=lambda fit: fit[:2])
    return target, pose


def reference_rows(runs: dict[str, Placed], reference: Plan, T_reference_map: FloatArray) -> list[tuple]:
    """For each run: where its own map fits the reference best, and how far the largest map has put it from there."""
    rows = []
    for name, run in runs.items():
        best, second = search(run.plan, reference)
        share = near_share(run.plan.points(run.plan.walls), best.T_target_query, reference)
        apart_m = np.nan
        if run.map_index == 0:
            there = se2.transform(se2.compose(T_reference_map, run.T_map_alone), run.middle)
            apart_m = float(np.linalg.norm(there - se2.transform(best.T_target_query, run.middle)))
        rows.append((name, best.score, second.score, share, apart_m))
    return rows


def draw(plan: Plan, together: Run, reference: Plan, T_reference_map: FloatArray, picture: Path) -> None:
    """The joint map and the reference under each other, in the reference's coordinates."""
    import cv2
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    top, bottom, left, right = FRAME_PX
    pixels = cv2.imread(str(picture), cv2.IMREAD_COLOR)[top:-bottom, left:-right]
    pixels[np.ptp(pixels, axis=2) > 40] = PAPER[::-1]
    height_m, width_m = (size * reference.cell_m for size in pixels.shape[:2])
    joined = [trajectory for trajectory in together.trajectories.values() if trajectory.map_index == 0]
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(9.0, 10.2), layout="constrained")
    ours = f"fcslam: {len(joined)} of {len(RUNS)} runs in one map"
    for axes, title in ((upper, ours), (lower, "reference map, same scale")):
        axes.set(xlim=(0, width_m), ylim=(0, height_m), aspect="equal", title=title, ylabel="m")
        axes.set_facecolor(np.array(PAPER) / 255)
    for cells, color, size in ((plan.free, "white", 1.2), (plan.walls, "#1f2a33", 0.8)):
        points = se2.transform(T_reference_map, plan.points(cells))
        upper.scatter(*points.T, s=size, c=color, marker="s", linewidths=0)
    for trajectory in joined:
        way = se2.transform(T_reference_map, trajectory.T_map_base[:, :2])
        upper.plot(*way.T, linewidth=1.0, label=trajectory.robot)
    upper.legend(loc="upper left", frameon=False)
    lower.imshow(pixels[..., ::-1], extent=(0, width_m, 0, height_m), interpolation="nearest")
    lower.set_xlabel("m. Wean Hall, Carnegie Mellon University; logs and reference map: course data of 16-833")
    figure.savefig(FIGURE, dpi=110)
    plt.close(figure)


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*LOGS, PICTURE)
    logs = [folder / log for log in LOGS]
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        joint, alone = Path(place) / "joint", Path(place) / "alone"
        cost = common.run_fcslam("map", *logs, "--output", joint)
        common.run_fcslam("map", *logs, "--no-fuse", "--output", alone)
        together = open_run(joint)
        runs = placed(open_run(alone), together, alone)
        plan = own_plan(joint, 0)
    pairs = pair_rows(runs, together)
    reference, T_reference_map = scaled_reference(folder / PICTURE, plan)
    share = near_share(plan.points(plan.walls), T_reference_map, reference)
    maps = len({trajectory.map_index for trajectory in together.trajectories.values()})
    report.say(
        f"{maps} map{'s' if maps > 1 else ''}, {cost.cpu_s:.1f} s of CPU. A cell of the picture is "
        f"{reference.cell_m} m wide; {share:.0%} of the largest map's walls lie within {NEAR_M} m of the reference's."
    )
    headings = {"run": "", "run ": "", "joined": "", "closures": "", "search: best": ".2f", "runner-up": ".2f",
                "off by, m": ".2f", "off by, deg": ".1f", "right": ""}  # fmt: skip
    report.table("Pairs of runs", headings, pairs)
    headings = {"run": "", "search: best": ".2f", "runner-up": ".2f", f"walls within {NEAR_M} m": ".0%",
                "joint map apart from it, m": ".2f"}  # fmt: skip
    report.table("Runs on the reference map", headings, reference_rows(runs, reference, T_reference_map))
    report.write()
    draw(plan, together, reference, T_reference_map, folder / PICTURE)
    if any(row[-1] == "NO" for row in pairs):
        sys.exit("a join is wrong")


if __name__ == "__main__":
    main()
