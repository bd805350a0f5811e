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
from pathlib import Path

import common
import numpy as np
from convert_logs import readable
from evaluation.map_search import PAIR_COLUMNS, FloatArray, Placed, Plan, map_together, mean_at, pair_rows, search

from fcslam.geometry import se2
from fcslam.runs import Run

RUNS = tuple(f"robotdata{number}" for number in range(1, 6))
LOGS = tuple(f"wean-hall/{run}.log.gz" for run in RUNS)
PICTURE = "wean-hall/wean-map.gif"
FRAME_PX = (17, 4, 2, 2)
"""The window's frame in the picture: top, bottom, left, right."""
FIGURE = common.REPOSITORY / "docs" / "images" / "wean-hall.png"

PAPER = (236, 239, 241)
"""Red, green, blue."""

SCALES_M = (0.088, 0.091, 0.094, 0.097, 0.1, 0.103)
NEAR_M = 0.3


def reference_plan(picture: Path, cell_m: float) -> Plan:
    """The picture's map: walls are the cells of black that face white, since black is as thick as it was drawn."""
    import cv2
    from scipy.ndimage import binary_dilation

    top, bottom, left, right = FRAME_PX
    pixels = cv2.imread(str(picture), cv2.IMREAD_COLOR)[top:-bottom, left:-right][::-1].astype(int)
    gray = pixels.max(axis=2) - pixels.min(axis=2) < 40
    white, black = gray & (pixels[..., 1] > 235), gray & (pixels[..., 1] < 60)
    return Plan(black & binary_dilation(white, np.ones((3, 3))), white, cell_m, np.zeros(2))


def near_share(points: FloatArray, pose: FloatArray, target: Plan) -> float:
    """Share of the points within ``NEAR_M`` of a wall of the target."""
    from scipy.ndimage import distance_transform_edt

    near = (distance_transform_edt(~target.walls) * target.cell_m <= NEAR_M).astype(np.float64)
    return mean_at(near, points, pose, target)


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
    logs = [readable(folder / log) for log in LOGS]
    report = common.Report(__file__, __doc__, chosen)
    together, runs, plan, cost = map_together(logs)
    pairs = pair_rows(runs, together)
    reference, T_reference_map = scaled_reference(folder / PICTURE, plan)
    share = near_share(plan.points(plan.walls), T_reference_map, reference)
    maps = len({trajectory.map_index for trajectory in together.trajectories.values()})
    report.say(
        f"{maps} map{'s' if maps > 1 else ''}, {cost.cpu_s:.1f} s of CPU. A cell of the picture is "
        f"{reference.cell_m} m wide; {share:.0%} of the largest map's walls lie within {NEAR_M} m of the reference's."
    )
    report.table("Pairs of runs", PAIR_COLUMNS, pairs)
    headings = {"run": "", "search: best": ".2f", "runner-up": ".2f", f"walls within {NEAR_M} m": ".0%",
                "joint map apart from it, m": ".2f"}  # fmt: skip
    report.table("Runs on the reference map", headings, reference_rows(runs, reference, T_reference_map))
    report.write()
    draw(plan, together, reference, T_reference_map, folder / PICTURE)
    if any(row[-1] == "NO" for row in pairs):
        sys.exit("a join is wrong")


if __name__ == "__main__":
    main()
