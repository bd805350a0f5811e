"""Accuracy and cost of the real command on three logs of the SLAM benchmark, alone and cut into several robots.

    FCSLAM_DATA=/path/to/data python benchmarks/relations.py

Each `fcslam map` has one core, as the peers below. CPU seconds are user and system. Warm runs find numba's compiled
code in its cache, which a run before them fills, cold ones compile everything. Errors follow Kuemmerle et al. 2009 over
all relations; "across robots" are those whose stamps belong to different robots and lie more than 20 s apart, and the
run of one robot is measured by the very same ones.

    FCSLAM_DATA=/path/to/data python benchmarks/relations.py --tracker karto

This maps each log once, as one robot, with another scan matcher; the report is `relations_karto` and has errors alone.
"""

import os
import tempfile
from pathlib import Path

import common

from fcslam.lab.evaluation.relations import evaluate_relations
from fcslam.metrics.relations import RelationErrors

PEERS = (
    ("raw odometry", "7.37 / 39", "6.50 / 30", "1.68 / 5.1"),
    ("open_karto, defaults", "0.0216 / 0.70, 67 s", "2.94 / 7.3, 70 s", "0.0396 / 1.05, 25 s"),
    ("slam_toolbox's Karto, defaults", "0.332 / 1.6, 15 s", "2.58 / 5.7, 12 s", "0.058 / 2.7, 8 s"),
    ("slam_toolbox's Karto, tuned once for all", "0.285 / 2.0, 59 s", "0.477 / 1.6, 61 s", "0.0370 / 1.06, 28 s"),
    ("Karto, search window of +-0.8 m", "0.0227 / 0.69, 167 s", "0.0440 / 1.26, 165 s", "0.0380 / 1.07, 50 s"),
    ("slam_toolbox's settings, Huber loss", "0.043 / 1.3, 14 s", "2.59 / 6.1, 11 s", "0.048 / 2.75, 7 s"),
    ("IRIS LaMa, dense, no loops", "0.0203 / 0.35, 1.9 s", "0.0385 / 0.57, 1.4 s", "0.118 / 2.0, 1.0 s"),
    ("IRIS LaMa, dense, pose graph", "0.0220 / 0.36, 1.9 s", "0.0377 / 0.62, 1.7 s", "0.0408 / 0.48, 1.1 s"),
    ("GMapping, 30 particles", "0.0405 / 1.9, 41 s", "2.58 / 10.4, 50 s", "0.0536 / 3.3, 38 s"),
    ("MRPT ICP", "3.7 / 23, 5 s", "0.93 / 6.8, 3 s", "0.24 / 2.0, 2 s"),
)
PEERS_SOURCE = (
    "Peers: mean error in m / deg over all relations and seconds, each raw scan posed by its keyscan's correction "
    "carried forward with odometry; one robot. Measured on the same class of machine (2-core x86, AMD EPYC), one "
    "thread each, November 2026."
)

SIX = ("mean, m", "std, m", "max, m", "mean, deg", "std, deg", "max, deg")
ERRORS = dict(zip(SIX, (".4f", ".4f", ".3f", ".3f", ".3f", ".2f"), strict=True))
COSTS = {"CPU, s": ".1f", "wall, s": ".1f", "x real time": ".0f", "peak, MB": ".0f", "cold CPU, s": ".1f",
         "cold wall, s": ".1f"}  # fmt: skip
ACROSS = {"relations across robots": "", "mean, m": ".4f", "max, m": ".3f", "mean, deg": ".3f",
          "one robot: mean, m": ".4f", "one robot: max, m": ".3f", "one robot: mean, deg": ".3f",
          "ratio of means": ".2f"}  # fmt: skip
CLOSURES = ("intra_robot_closures_accepted", "intra_robot_closures_revoked", "inter_robot_closures_accepted",
            "inter_robot_closures_revoked", "inter_robot_closures_rejected")  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--no-cold", action="store_true", help="leave out the runs that compile everything")
    parser.add_argument("--repeat", type=int, default=1, help="warm runs of each; the quickest counts")
    parser.add_argument("--tracker", choices=("surfels", "karto"), default="surfels", help="scan matcher")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if chosen.tracker != "surfels":
        report_tracker(chosen, folder)
        return
    report = common.Report(__file__, __doc__, chosen)
    alone, together, across, closures = [], [], [], []
    with tempfile.TemporaryDirectory() as place:
        for name, parts in common.SPLITS.items():
            log, reference = common.log_path(folder, name), common.relations_path(folder, name)
            one, several = Path(place) / f"{name}-1", Path(place) / f"{name}-{parts}"
            cost_one = measure(chosen, log, one, 1)
            cost_several = measure(chosen, log, several, parts)
            errors = [evaluate_relations(run, reference) for run in (one, several)]
            alone.append((name, used(errors[0]), *six(errors[0]), *cost_one))
            maps = int(common.metrics(several)["maps"])
            cpu_ratio = cost_several[0] / cost_one[0]
            together.append((name, parts, maps, used(errors[1]), *six(errors[1]), *cost_several, cpu_ratio))
            across.append((name, parts, *across_robots(one, several, reference)))
            closures += [(name, robots, *closure_counts(run)) for run, robots in ((one, 1), (several, parts))]
    report.table("One robot", {"log": "", "relations used": "", **ERRORS, **COSTS}, alone)
    several_columns = {"log": "", "robots": "", "maps": "", "relations used": "", **ERRORS, **COSTS}
    report.table("Several robots", {**several_columns, "CPU, times that of one robot": ".2f"}, together)
    report.table("Across robots", {"log": "", "robots": "", **ACROSS}, across)
    names = [name.replace("_closures", "").replace("_", " ") for name in CLOSURES]
    report.table("Closures", {"log": "", "robots": "", **dict.fromkeys(names, ".0f")}, closures)
    report.say(PEERS_SOURCE)
    report.table("Peers", dict.fromkeys(("", *common.SPLITS), ""), PEERS)
    report.write()


def report_tracker(chosen, folder: Path) -> None:
    """Errors of one robot with the scan matcher ``chosen.tracker``."""
    report = common.Report(f"relations_{chosen.tracker}", __doc__, chosen)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for name in common.SPLITS:
            run = Path(place) / name
            setting = f"robot.lidar.tracker={chosen.tracker}"
            common.run_fcslam("map", common.log_path(folder, name), "--output", run, "--config", setting)
            errors = evaluate_relations(run, common.relations_path(folder, name))
            counts = common.metrics(run)
            rows.append((name, used(errors), *six(errors), counts["intra_robot_closures_accepted"]))
    columns = {"log": "", "relations used": "", **ERRORS, "closures accepted": ".0f"}
    report.table(f"One robot, tracker {chosen.tracker}", columns, rows)
    report.say(PEERS_SOURCE)
    report.table("Peers", dict.fromkeys(("", *common.SPLITS), ""), PEERS)
    report.write()


def measure(chosen, log: Path, run: Path, parts: int) -> tuple[float, ...]:
    """Cost of mapping ``log`` as ``parts`` robots, in the columns' order; the run folder stays at ``run``."""
    arguments = ("map", log, "--output", run, "--split", parts, "--force")
    common.run_fcslam(*arguments)  # fills numba's cache
    warm = min((common.run_fcslam(*arguments) for _ in range(chosen.repeat)), key=lambda cost: cost.cpu_s)
    speed = common.metrics(run)["recorded_time"] / warm.wall_s
    nothing = common.Cost(float("nan"), float("nan"), float("nan"))
    cold = nothing if chosen.no_cold else common.run_fcslam_cold(*arguments)
    return warm.cpu_s, warm.wall_s, speed, warm.peak_mb, cold.cpu_s, cold.wall_s


def six(errors: RelationErrors) -> tuple[float, ...]:
    """Mean, standard deviation and maximum of translation and rotation."""
    return tuple(x for e in (errors.translation, errors.rotation) for x in (e.mean, e.std, e.maximum))


def used(errors: RelationErrors) -> str:
    return f"{errors.used} of {errors.total}"


def across_robots(one: Path, several: Path, reference: Path) -> tuple:
    """Errors across robots of the run of several, and of one robot's run on the same relations."""
    joint = evaluate_relations(several, reference, across_robots=True)
    single = evaluate_relations(one, reference, across_robots=True, parts=several)
    figures = [x for e in (joint, single) for x in (e.translation.mean, e.translation.maximum, e.rotation.mean)]
    return used(joint), *figures, joint.translation.mean / single.translation.mean


def closure_counts(run: Path) -> list[float]:
    counts = common.metrics(run)
    return [counts[name] for name in CLOSURES]


if __name__ == "__main__":
    main()
