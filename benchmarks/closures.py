"""How many of the accepted closures between robots are true: the split runs against the reference relations.

    FCSLAM_DATA=/path/to/data python benchmarks/closures.py

A closure is covered if a relation's two stamps lie within 1 s of the closure's and belong to the same robots. What
lies between the stamps (at most 1 s on either side) is bridged by the run's own trajectory, which over so short a time
is good to millimetres. A covered closure is wrong if it differs from the bridged relation by more than 0.5 m or
10 deg. Of several relations the one nearest in time counts.
"""

import tempfile
from pathlib import Path

import common
import numpy as np

from fcslam.evaluation.relations import pose_table
from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable, Relations, read_relations
from fcslam.records import ClosureStatus
from fcslam.runs import ClosureRow, open_run

BRIDGE_S, WRONG_M, WRONG_DEG = 1.0, 0.5, 10.0
COLUMNS = {"log": "", "status": "", "closures": "", "covered": "", "coverage": ".1%", "wrong": "",
           "wrong of covered": ".2%", "median, m": ".3f", "99 %, m": ".3f", "max, m": ".3f", "median, deg": ".2f",
           "max, deg": ".2f"}  # fmt: skip


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for name, parts in common.SPLITS.items():
            folder_of_run = Path(place) / name
            common.run_fcslam("map", common.log_path(folder, name), "--output", folder_of_run, "--split", parts)
            run = open_run(folder_of_run)
            reference = both_ways(read_relations(common.relations_path(folder, name)))
            for status in (ClosureStatus.ACCEPTED, ClosureStatus.REVOKED, ClosureStatus.REJECTED):
                between = [c for c in run.closures if c.robot_i != c.robot_j and c.status is status]
                rows.append((name, status.value, *summary(between, pose_table(run), reference)))
    report.say("Revoked and rejected closures stand beside the accepted ones to show what was turned down.")
    report.table("Closures between robots", COLUMNS, rows)
    report.write()


def both_ways(relations: Relations) -> Relations:
    """Each relation and its inverse."""
    stamps = np.concatenate((relations.stamps, relations.stamps[:, ::-1]))
    return Relations(stamps, np.concatenate((relations.T_1_2, se2.inverse(relations.T_1_2))))


def summary(closures: list[ClosureRow], poses: PoseTable, reference: Relations) -> tuple:
    """The table's numbers for one set of closures."""
    compared = [error for c in closures if (error := closure_error(c, poses, reference)) is not None]
    errors = np.array(compared).reshape(-1, 2)
    wrong = int(np.sum((errors[:, 0] > WRONG_M) | (errors[:, 1] > WRONG_DEG)))
    counts = (len(closures), len(errors), share(len(errors), len(closures)), wrong, share(wrong, len(errors)))
    if not len(errors):
        return *counts, *[np.nan] * 5
    metres, degrees = errors.T
    return *counts, np.median(metres), np.quantile(metres, 0.99), metres.max(), np.median(degrees), degrees.max()


def share(part: int, whole: int) -> float:
    return part / whole if whole else np.nan


def closure_error(closure: ClosureRow, poses: PoseTable, reference: Relations) -> tuple[float, float] | None:
    """|translation| in m and |rotation| in degrees off the reference; None if no relation is near enough."""
    ends = poses.find([closure.stamp_i, closure.stamp_j])
    rows = poses.find(reference.stamps)
    away = np.abs(reference.stamps - [closure.stamp_i, closure.stamp_j])
    near = np.all((away <= BRIDGE_S) & (rows >= 0), axis=1) & np.all(poses.robots[rows] == poses.robots[ends], axis=1)
    if np.any(ends < 0) or not near.any():
        return None
    best = np.flatnonzero(near)[np.argmin(away[near].sum(axis=1))]
    T = poses.T_map_base
    T_i_a, T_b_j = se2.between(T[ends[0]], T[rows[best, 0]]), se2.between(T[rows[best, 1]], T[ends[1]])
    expected = se2.compose(se2.compose(T_i_a, reference.T_1_2[best]), T_b_j)
    error = se2.between(expected, closure.T_i_j)
    return float(np.hypot(error[0], error[1])), float(np.degrees(abs(error[2])))


if __name__ == "__main__":
    main()
