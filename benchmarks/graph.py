"""Seconds that the solvers take on public pose graphs, and what they make of false loops.

    FCSLAM_DATA=/path/to/data python benchmarks/graph.py
    FCSLAM_DATA=/path/to/data python benchmarks/graph.py --gtsam    # and GTSAM's own GNC, about a minute more

Levenberg-Marquardt (LM, squared loss) and graduated non-convexity (GNC). Starts: the file's own poses; odometry
chained; chordal relaxation with closures reweighted. Edges between consecutive variables are odometry, all others
closures. A false loop joins two random variables more than 10 apart by the measurement of a random true closure.
Times are process CPU, the start's not included; of the repeats the quickest counts.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import common
import gtsam
import numpy as np

from fcslam.graph.factors import FactorCache, from_values, to_values
from fcslam.graph.g2o import read_g2o
from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.optimizer import Solution, SolveStats, optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph, anchors
from fcslam.records import FloatArray

Solver = Callable[[PoseGraph, FloatArray], Solution]

GRAPHS = ("m3500", "intel_1228", "vertigo_intel_943")
FALSE_LOOPS = 100
INLIER_PROBABILITY = 0.99
COLUMNS = {"graph": "", "variables": "", "closures": "", "start": "", "start, s": ".2f", "LM, s": ".2f",
           "LM iterations": "", "LM cost": ".4g", "GNC, s": ".2f", "GNC iterations": "", "GNC cost": ".4g",
           "GNC rejects": ""}  # fmt: skip
FALSE_COLUMNS = {"graph": "", "seed": "", "start": "", "solver": "", "s": ".1f", "false rejected": "", "true lost": "",
                 "of true": "", "largest shift from the clean solution, m": ".2f", "cost": ".1f",
                 "cost from the clean solution": ".1f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--gtsam", action="store_true", help="GTSAM's GncLMOptimizer on the graph with false loops")
    parser.add_argument("--repeat", type=int, default=3, help="solves of each; the quickest counts")
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2, 3), help="of the false loops")
    parser.add_argument("--graphs", nargs="+", default=GRAPHS, help="names of files; city10000 takes minutes")
    chosen = parser.parse_args()
    files = {name: f"posegraph/{name}.g2o.gz" for name in dict.fromkeys((*chosen.graphs, "m3500"))}
    folder = common.recordings(*files.values())
    report = common.Report(__file__, __doc__, chosen)
    graphs = {name: read_g2o(folder / path).graph for name, path in files.items()}
    report.say(
        "Cost: half the sum of squared Mahalanobis residuals (LM), of truncated ones on closures (GNC); residuals are "
        "differences of x, y and heading, as those that decide which closures hold, while GTSAM minimises their "
        "logarithm. The two differ where headings are far off and weights large (intel_1228)."
    )
    report.table("Public graphs", COLUMNS, [row for item in graphs.items() for row in solves(*item, chosen.repeat)])
    rows = false_loop_rows("m3500", graphs["m3500"], chosen)
    report.table(f"With {FALSE_LOOPS} false loops", FALSE_COLUMNS, rows)
    report.write()


def starts(graph: PoseGraph) -> dict[str, Callable[[], FloatArray]]:
    return {
        "file": graph.poses,
        "odometry": lambda: initialize(graph, (~graph.arrays().robust).astype(float)),
        "chordal, reweighted": lambda: initialize_robust(graph),
    }


def solves(name: str, graph: PoseGraph, repeat: int) -> list[tuple]:
    robust = graph.arrays().robust
    rows = []
    for start, make in starts(graph).items():
        start_s, poses = timed(make, 1)
        lm_s, lm = timed(lambda poses=poses: optimize(graph, poses), repeat)
        gnc_s, gnc = timed(lambda poses=poses: optimize_gnc(graph, poses), repeat)
        rejects = int(np.sum(gnc.weights[robust] < 0.5))
        lm_columns = (lm_s, lm.stats.iterations, 0.5 * graph.chi2(lm.poses).sum())
        gnc_columns = (gnc_s, gnc.stats.iterations, gnc.stats.final_cost, rejects)
        rows.append((name, len(graph), int(robust.sum()), start, start_s, *lm_columns, *gnc_columns))
    return rows


def false_loop_rows(name: str, clean: PoseGraph, chosen: argparse.Namespace) -> list[tuple]:
    truth = optimize_gnc(clean).poses
    rows = []
    for seed in chosen.seeds:
        graph = with_false_loops(clean, FALSE_LOOPS, np.random.default_rng(seed))
        good = optimize_gnc(graph, truth).stats.final_cost
        for start in ("odometry", "chordal, reweighted"):
            poses = starts(graph)[start]()
            solvers: dict[str, Solver] = {"LM": optimize_plainly, "GNC": optimize_gnc}
            if chosen.gtsam and start == "odometry" and seed == chosen.seeds[0]:
                solvers["GTSAM's GNC"] = gtsam_gnc
            for solver, solve in solvers.items():
                seconds, solution = timed(lambda solve=solve, poses=poses, graph=graph: solve(graph, poses), 1)
                figures = decisions(graph, solution, truth)
                rows.append((name, seed, start, solver, seconds, *figures, good))
    return rows


def optimize_plainly(graph: PoseGraph, start: FloatArray) -> Solution:
    return optimize(graph, start)


def decisions(graph: PoseGraph, solution: Solution, truth: FloatArray) -> tuple:
    """False loops rejected, true ones lost, of how many, largest shift in m, cost."""
    kept = solution.weights[graph.arrays().robust] >= 0.5
    rejected, lost = int(np.sum(~kept[-FALSE_LOOPS:])), int(np.sum(~kept[:-FALSE_LOOPS]))
    shift_m = np.hypot(*(solution.poses - truth)[:, :2].T).max()
    return rejected, lost, len(kept) - FALSE_LOOPS, shift_m, solution.stats.final_cost


def with_false_loops(graph: PoseGraph, count: int, rng: np.random.Generator) -> PoseGraph:
    """The graph with ``count`` more closures, which are its last edges."""
    closures = [edge for edge in graph.edges if edge.robust]
    false: list[Edge] = []
    while len(false) < count:
        i, j = sorted(rng.integers(0, len(graph), 2).tolist())
        if j - i > 10:
            model = closures[rng.integers(len(closures))]
            false.append(Edge(i, j, model.T_i_j, model.information, robust=True))
    return PoseGraph(graph.poses(), [*graph.edges, *false])


def gtsam_gnc(graph: PoseGraph, start: FloatArray) -> Solution:
    """GTSAM's own graduated non-convexity; odometry and the anchor are known to be true."""
    robust = graph.arrays().robust
    problem = FactorCache(graph).squared(np.ones(int(robust.sum())), start)
    trusted = int((~robust).sum())
    priors = len(anchors(graph.components()))
    known = [*range(trusted), *range(problem.size() - priors, problem.size())]
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(known)
    solver = gtsam.GncLMOptimizer(problem, to_values(start), parameters)
    solver.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
    poses = from_values(solver.optimize())
    weights = np.ones(len(robust))
    weights[robust] = np.asarray(solver.getWeights())[trusted : trusted + int(robust.sum())]
    return Solution(poses, weights, SolveStats(0, np.nan, np.nan))


def timed(work: Callable[[], Any], repeat: int) -> tuple[float, Any]:
    """CPU seconds of the quickest of ``repeat`` calls, and the last call's result."""
    seconds = []
    for _ in range(repeat):
        began = time.process_time()
        result = work()
        seconds.append(time.process_time() - began)
    return min(seconds), result


if __name__ == "__main__":
    main()
