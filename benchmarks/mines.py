"""Four real runs through one laboratory with a short-range scanner, mapped together.

    FCSLAM_DATA=/path/to/data python benchmarks/mines.py

Mines ParisTech's rover (B. Steux, O. El Hamzaoui, "tinySLAM", ICARCV 2010): a Hokuyo URG-04LX of 4 m, encoders, about a
minute each. Nobody recorded where it was, so every join is checked as in wean_hall.py: the whole map of one run, made
alone, is laid on that of the other at every position and heading. The runner-up is the best pose at least 3 m or 45
degrees off the best; a score close to the best's means that the search cannot tell.

Passed: the four runs are in one map, and every join is right; the script fails otherwise. In the picture every run's
own map lies where the joint map has put it: walls of different colours lie on each other where the joins are right.
"""

import sys

import common
from convert_logs import readable
from evaluation.map_search import PAIR_COLUMNS, Together, map_together, pair_rows

from fcslam.geometry import se2

RUNS = tuple(f"exp{number}" for number in range(1, 5))
LOGS = tuple(f"mines-coreslam/{run}.dat.gz" for run in RUNS)


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*LOGS)
    report = common.Report(__file__, __doc__, chosen)
    together = map_together([readable(folder / log) for log in LOGS])
    pairs = pair_rows(together.runs, together.run)
    maps = len({trajectory.map_index for trajectory in together.run.trajectories.values()})
    report.say(f"{maps} map{'s' if maps > 1 else ''}, {together.cost.cpu_s:.1f} s of CPU.")
    report.table("Pairs of runs", PAIR_COLUMNS, pairs)
    report.picture("Walls of every run's own map, where the joint map has put it", figure(together))
    report.write()
    if maps > 1 or any(row[-1] == "NO" for row in pairs):
        sys.exit("the runs are in several maps, or a join is wrong")


def figure(together: Together) -> object:
    """One picture for each joint map: every run's walls and drive, in colours."""
    from matplotlib.figure import Figure

    maps = sorted({run.map_index for run in together.runs.values()})
    drawn = Figure(figsize=(9.0 * len(maps), 9.0), layout="constrained")
    for axes, number in zip(drawn.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
        for name, run in together.runs.items():
            if run.map_index == number:
                walls = se2.transform(run.T_map_alone, run.plan.points(run.plan.walls))
                (line,) = axes.plot(*together.run.trajectories[name].T_map_base[:, :2].T, linewidth=1.0, label=name)
                axes.scatter(*walls.T, s=2.0, color=line.get_color(), marker="s", linewidths=0)
        axes.set(aspect="equal", xlabel="m", ylabel="m", title=f"map {number}")
        axes.legend(frameon=False)
    return drawn


if __name__ == "__main__":
    main()
