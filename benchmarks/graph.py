"""Seconds that the solvers take on public pose graphs without a false closure, from good and from bad starts.

    FCSLAM_DATA=/path/to/data python benchmarks/graph.py

Levenberg-Marquardt (LM, squared loss) and graduated non-convexity (GNC). Starts: the file's own poses; odometry
chained; chordal relaxation with closures reweighted. Edges between consecutive variables are odometry, all others
closures. What false ones do is in robust_graph.py. Times are process CPU, the start's not included; of the repeats the
quickest counts. Cost: half the sum of squared Mahalanobis residuals (LM), of truncated ones on closures (GNC).
"""

import time
from collections.abc import Callable
from typing import Any

import common
import numpy as np
from evaluation.g2o_files import read_g2o

from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray

GRAPHS = ("m3500", "intel_1228", "vertigo_intel_943")
COLUMNS = {"graph": "", "variables": "", "closures": "", "start": "", "start, s": ".2f", "LM, s": ".2f",
           "LM iterations": "", "LM cost": ".4g", "GNC, s": ".2f", "GNC iterations": "", "GNC cost": ".4g",
           "GNC rejects": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--repeat", type=int, default=3, help="solves of each; the quickest counts")
    parser.add_argument("--graphs", nargs="+", default=GRAPHS, help="names of files; city10000 takes minutes")
    chosen = parser.parse_args()
    files = {name: f"posegraph/{name}.g2o.gz" for name in chosen.graphs}
    folder = common.recordings(*files.values())
    report = common.Report(__file__, __doc__, chosen)
    graphs = {name: read_g2o(folder / path).graph for name, path in files.items()}
    report.table("Public graphs", COLUMNS, [row for item in graphs.items() for row in solves(*item, chosen.repeat)])
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
        lm_columns = (lm_s, lm.iterations, 0.5 * graph.chi2(lm.poses).sum())
        gnc_columns = (gnc_s, gnc.iterations, gnc.cost, rejects)
        rows.append((name, len(graph), int(robust.sum()), start, start_s, *lm_columns, *gnc_columns))
    return rows


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
