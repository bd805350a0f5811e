"""Pose graphs in which most closures lie: what is kept, what is rejected, how far the map bends.

    FCSLAM_DATA=/path/to/data python benchmarks/robust_graph.py

Several robots: the INTEL graph is cut into 3 robots of equal length, each in an odometry frame of its own; the odometry
from the end of one to the beginning of the next is left out. False closures between robots are added until they are the
stated share of all closures between robots. A false closure claims that two places of different robots are one, up to
N(0, 0.3 m) and N(0, 10 deg), with the information of a random true closure:

- random: two places drawn at random;
- local: two places that truly are 1 to 5 m apart, so that the lie is small;
- groups: ten places in a row of each robot, all under one false motion between the robots, with the noise that their
  information states: they agree with one another.

A closure that happens to be right within 0.5 m and 10 deg is drawn again. Compared with the optimum of the graph
without false closures, both held at the first pose: the root mean square distance of all poses of all robots. Passed:
at most 0.05 m, and at least 90 % of the true closures between robots kept. Beside it: least squares from the chordal
solution of all edges (the first draw), and graduated non-convexity (GNC) from the odometry, both with every
closure and nothing else.

Two robots: the CSAIL graph cut in two with 250 false closures added, within robots and between them, as published with
pairwise consistency (PCM, Mangelson et al. 2018).

One robot: m3500 with 100 false loops, each between two random variables more than 10 apart with the measurement of a
random true closure. Passed: all rejected, at most 5 true ones lost.

Seconds are CPU time of the process, from the bare edges to the last decision.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import common
import numpy as np
from evaluation.g2o_files import read_g2o
from numpy.random import Generator
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.graph.evidence import ConsistencySettings
from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.joint import JointEvidence, solve_jointly
from fcslam.graph.optimizer import Solution, optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.single_robot import solve_single_robot
from fcslam.records import FloatArray

ROBOTS = 3
INTEL = ("vertigo_intel_943", "intel_1228")
CSAIL_FILES, CSAIL_FIRST = ("CSAIL.g2o.gz", "CSAIL_outliers.g2o.gz"), 523
"""So many poses are the first robot's."""
SHARES, KINDS = (0.1, 0.7), ("random", "local", "groups")
WRONG_M, WRONG_RAD = 0.5, np.radians(10.0)
LIE_SIGMA = np.array([0.3, 0.3, np.radians(10.0)])
GROUP = 10
PLAIN_SEEDS = 1
"""Least squares never converges on such a graph and takes longer than all the rest."""
REPORTED_SEEDS = 3
"""Of graphs that nothing is required of."""
FALSE_LOOPS = 100
PASS_RMSE_M, PASS_KEPT, PASS_LOST = 0.05, 0.9, 5

JOINT = {"graph": "", "false": ".0%", "kind": "", "runs": "", "passed": "", "RMSE median, m": ".4f",
         "RMSE worst, m": ".4f", "true kept, worst": ".1%", "false kept, all runs": "", "of false": "",
         "s, worst": ".1f", "least squares, median m": ".2f", "GNC alone, median m": ".2f",
         "GNC alone passed": ""}  # fmt: skip
RUNS = {"graph": "", "false": ".0%", "kind": "", "seed": "", "maps": "", "RMSE, m": ".4f", "true kept": ".1%",
        "false kept": "", "s": ".2f", "least squares, m": ".2f", "GNC alone, m": ".2f", "GNC alone true kept": ".1%",
        "of false": ""}  # fmt: skip
CSAIL = {"maps": "", "RMSE, m": ".6f", "true kept": "", "of true": "", "false kept": "", "of false": "", "s": ".2f",
         "least squares, m": ".2f", "GNC alone, m": ".2f"}  # fmt: skip
ALONE = {"seed": "", "solver": "", "s": ".1f", "false rejected": "", "true lost": "", "of true": "",
         "largest shift from the clean solution, m": ".2f", "cost": ".1f", "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="draws of each kind")
    parser.add_argument("--graphs", nargs="+", default=INTEL, help="names of files")
    chosen = parser.parse_args()
    files = [f"posegraph/{name}.g2o.gz" for name in (*chosen.graphs, "m3500")]
    folder = common.recordings(*files, *(f"posegraph-multirobot/{name}" for name in CSAIL_FILES))
    report = common.Report(__file__, __doc__, chosen)
    draws = {name: chosen.seeds if name == INTEL[0] else min(chosen.seeds, REPORTED_SEEDS) for name in chosen.graphs}
    runs = [row for name, seeds in draws.items() for row in joint_runs(name, load(folder, name), seeds)]
    report.table("Three robots", JOINT, [summary(key, group) for key, group in grouped(runs).items()])
    report.say(
        "intel_1228 is reported, not required: its information matrices are ill-conditioned (its closures claim 0.3 m "
        "where its odometry claims millimetres in one direction and half a metre in another), robots 2 and 3 share no "
        "true closure, and a lie of less than a metre is then no contradiction."
    )
    report.table("CSAIL cut in two, 250 false closures", CSAIL, [csail_row(folder)])
    report.table("m3500 with 100 false loops", ALONE, loop_rows(load(folder, "m3500"), chosen))
    report.table("Every run with three robots", RUNS, runs)
    report.write()


def load(folder: Path, name: str) -> PoseGraph:
    return read_g2o(folder / f"posegraph/{name}.g2o.gz").graph


# Several robots


def joint_runs(name: str, whole: PoseGraph, seeds: int) -> list[tuple]:
    clean = cut(whole, robot_of(whole))
    optimum = optimize(clean, initialize_robust(clean)).poses
    return [
        (name, share, kind, seed, *joint_run(clean, optimum, share, kind, seed))
        for share in SHARES
        for kind in KINDS
        for seed in range(seeds)
    ]


def robot_of(graph: PoseGraph) -> NDArray[np.int64]:
    return np.arange(len(graph)) * ROBOTS // len(graph)


def cut(graph: PoseGraph, robot: NDArray[np.int64]) -> PoseGraph:
    """The graph without poses, and without the odometry from the end of one robot to the beginning of the next."""
    kept = [edge for edge in graph.edges if edge.robust or robot[edge.i] == robot[edge.j]]
    return PoseGraph(np.zeros((len(graph), 3)), kept)


def joint_run(clean: PoseGraph, optimum: FloatArray, share: float, kind: str, seed: int) -> tuple:
    rng = np.random.default_rng(seed)
    robot = robot_of(clean)
    edges = clean.arrays()
    true = np.flatnonzero(edges.robust & (robot[edges.i] != robot[edges.j]))
    lies = draw_lies(clean, optimum, round(len(true) * share / (1.0 - share)), kind, rng)
    graph = PoseGraph(clean.poses(), [*clean.edges, *lies])
    count = len(graph.edges)
    false = np.arange(len(clean.edges), count)
    robots = tuple(np.flatnonzero(robot == number) for number in range(ROBOTS))
    evidence = JointEvidence(graph, robots, np.ones(count, bool), np.ones(count, bool), np.zeros(count, bool))
    began = time.process_time()
    solution = solve_jointly(evidence, ConsistencySettings())
    seconds = time.process_time() - began
    least_squares_m = rmse(optimize(graph, initialize(graph)).poses, optimum) if seed < PLAIN_SEEDS else np.nan
    gnc = optimize_gnc(graph, odometry(graph))
    return (
        len(set(solution.maps)), rmse(solution.poses, optimum), solution.weights[true].mean(),
        int(solution.weights[false].sum()), seconds, least_squares_m, rmse(gnc.poses, optimum),
        gnc.weights[true].mean(), len(false),
    )  # fmt: skip


def rmse(poses: FloatArray, optimum: FloatArray) -> float:
    """Of the distances in m, both held at the first pose."""
    apart = se2.between(poses[0], poses)[:, :2] - se2.between(optimum[0], optimum)[:, :2]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def grouped(runs: list[tuple]) -> dict[tuple, list[tuple]]:
    groups: dict[tuple, list[tuple]] = {}
    for run in runs:
        groups.setdefault(run[:3], []).append(run)
    return groups


def summary(key: tuple, runs: list[tuple]) -> tuple:
    _, _, _, _, _, errors, kept, false_kept, seconds, plain, gnc, gnc_kept, false = (
        np.array(column) for column in zip(*runs, strict=True)
    )
    passed = int(np.sum((errors <= PASS_RMSE_M) & (kept >= PASS_KEPT)))
    gnc_passed = int(np.sum((gnc <= PASS_RMSE_M) & (gnc_kept >= PASS_KEPT)))
    figures = (np.median(errors), errors.max(), kept.min(), int(false_kept.sum()), int(false.sum()), seconds.max())
    return (*key, len(runs), passed, *figures, np.nanmedian(plain), np.median(gnc), gnc_passed)


def draw_lies(graph: PoseGraph, optimum: FloatArray, count: int, kind: str, rng: Generator) -> list[Edge]:
    robot = robot_of(graph)
    edges = graph.arrays()
    models = np.flatnonzero(edges.robust & (robot[edges.i] != robot[edges.j]))
    draw = {"random": random_lies, "local": local_lies, "groups": group_lies}[kind]
    lies: list[Edge] = []
    while len(lies) < count:
        information = edges.information[rng.choice(models)]
        for i, j, T_i_j in draw(optimum, robot, information, rng):
            off = se2.between(se2.between(optimum[i], optimum[j]), T_i_j)
            if np.hypot(off[0], off[1]) > WRONG_M or abs(off[2]) > WRONG_RAD:
                lies.append(Edge(i, j, T_i_j, information, robust=True))
    return lies[:count]


def random_lies(optimum: FloatArray, robot: NDArray[np.int64], _information: FloatArray, rng: Generator) -> list[tuple]:
    i, j = rng.integers(0, len(optimum), 2).tolist()
    return [(i, j, lie(rng))] if robot[i] != robot[j] else []


def local_lies(optimum: FloatArray, robot: NDArray[np.int64], _information: FloatArray, rng: Generator) -> list[tuple]:
    i = int(rng.integers(len(optimum)))
    distance = np.hypot(*(optimum[:, :2] - optimum[i, :2]).T)
    near = np.flatnonzero((robot != robot[i]) & (distance > 1.0) & (distance < 5.0))
    return [(i, int(rng.choice(near)), lie(rng))] if len(near) else []


def group_lies(optimum: FloatArray, robot: NDArray[np.int64], information: FloatArray, rng: Generator) -> list[tuple]:
    i, j = rng.integers(0, len(optimum), 2).tolist()
    rows = [(i + k, j + k) for k in range(GROUP) if max(i, j) + k < len(optimum)]
    rows = [(a, b) for a, b in rows if robot[a] == robot[i] != robot[j] == robot[b]]
    T_map_map = se2.compose(se2.compose(optimum[i], lie(rng)), se2.inverse(optimum[j]))
    noise = rng.multivariate_normal(np.zeros(3), np.linalg.inv(information), len(rows))
    moved = [se2.between(optimum[a], se2.compose(T_map_map, optimum[b])) for a, b in rows]
    return [(a, b, se2.compose(T, se2.exp(off))) for (a, b), T, off in zip(rows, moved, noise, strict=True)]


def lie(rng: Generator) -> FloatArray:
    """That two places are one, or nearly so."""
    return rng.normal(0.0, LIE_SIGMA)


# Two robots


def csail_row(folder: Path) -> tuple:
    whole = [read_g2o(folder / "posegraph-multirobot" / name).graph for name in CSAIL_FILES]
    clean, graph = (cut(graph, (np.arange(len(graph)) >= CSAIL_FIRST).astype(np.int64)) for graph in whole)
    optimum = optimize(clean, initialize_robust(clean)).poses
    known = {(edge.i, edge.j, *edge.T_i_j) for edge in clean.edges}
    robust = graph.arrays().robust
    true = robust & np.array([(edge.i, edge.j, *edge.T_i_j) in known for edge in graph.edges])
    robots = np.arange(CSAIL_FIRST), np.arange(CSAIL_FIRST, len(graph))
    count = len(graph.edges)
    evidence = JointEvidence(graph, robots, np.ones(count, bool), np.ones(count, bool), np.zeros(count, bool))
    began = time.process_time()
    solution = solve_jointly(evidence, ConsistencySettings())
    seconds = time.process_time() - began
    false = robust & ~true
    return (
        len(set(solution.maps)), rmse(solution.poses, optimum), int(solution.weights[true].sum()), int(true.sum()),
        int(solution.weights[false].sum()), int(false.sum()), seconds,
        rmse(optimize(graph, initialize(graph)).poses, optimum),
        rmse(optimize_gnc(graph, odometry(graph)).poses, optimum),
    )  # fmt: skip


# One robot


def loop_rows(clean: PoseGraph, chosen: argparse.Namespace) -> list[tuple]:
    truth = optimize_gnc(clean).poses
    solvers: dict[str, Callable[[PoseGraph], Solution]] = {
        "ours": solve_single_robot,
        "GNC from odometry": lambda graph: optimize_gnc(graph, odometry(graph)),
        "least squares": lambda graph: optimize(graph, odometry(graph)),
    }
    rows = []
    for seed in range(chosen.seeds):
        graph = with_false_loops(clean, np.random.default_rng(seed))
        for solver, solve in solvers.items():
            if solver == "least squares" and seed >= PLAIN_SEEDS:
                continue
            began = time.process_time()
            solution = solve(graph)
            rows.append((seed, solver, time.process_time() - began, *decisions(graph, solution, truth)))
    return rows


def odometry(graph: PoseGraph) -> FloatArray:
    return initialize(graph, (~graph.arrays().robust).astype(float))


def decisions(graph: PoseGraph, solution: Solution, truth: FloatArray) -> tuple:
    """False loops rejected, true ones lost, of how many, largest shift in m, cost, whether that is enough."""
    kept = solution.weights[graph.arrays().robust] >= 0.5
    rejected, lost = int(np.sum(~kept[-FALSE_LOOPS:])), int(np.sum(~kept[:-FALSE_LOOPS]))
    shift_m = np.hypot(*(solution.poses - truth)[:, :2].T).max()
    passed = "yes" if rejected == FALSE_LOOPS and lost <= PASS_LOST else "NO"
    return rejected, lost, len(kept) - FALSE_LOOPS, shift_m, solution.cost, passed


def with_false_loops(graph: PoseGraph, rng: Generator) -> PoseGraph:
    """The graph with more closures, which are its last edges."""
    closures = [edge for edge in graph.edges if edge.robust]
    false: list[Edge] = []
    while len(false) < FALSE_LOOPS:
        i, j = sorted(rng.integers(0, len(graph), 2).tolist())
        if j - i > 10:
            model = closures[rng.integers(len(closures))]
            false.append(Edge(i, j, model.T_i_j, model.information, robust=True))
    return PoseGraph(graph.poses(), [*graph.edges, *false])


if __name__ == "__main__":
    main()
