"""How many of the accepted closures between robots are true: the split runs against the reference relations.

    FCSLAM_DATA=/path/to/data python benchmarks/closures.py

A closure is covered by one relation if the relation's two stamps lie within 1 s of the closure's and belong to the same
robots; of several the one nearest in time counts. It is covered by a chain if up to six links lead from one end to the
other: relations, and steps of at most 1 s between stamps of one robot. What lies between stamps is bridged by the run's
own trajectory, which over so short a time is good to millimetres. A covered closure is wrong if it differs from the
relation, or the chain, by more than 0.5 m or 10 deg.
"""

import tempfile
from pathlib import Path

import common
import numpy as np

from fcslam.evaluation.relations import pose_table
from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable, Relations, read_relations
from fcslam.records import ClosureStatus, FloatArray
from fcslam.runs import ClosureRow, Run, open_run

BRIDGE_S, WRONG_M, WRONG_DEG = 1.0, 0.5, 10.0
LINKS = 6
COLUMNS = {"log": "", "status": "", "reference": "", "closures": "", "covered": "", "coverage": ".1%", "wrong": "",
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
            reference = Reference(read_relations(common.relations_path(folder, name)), pose_table(run))
            rows += [(name, *row) for row in status_rows(run, reference)]
    report.say("Revoked and rejected closures stand beside the accepted ones to show what was turned down.")
    report.table("Closures between robots", COLUMNS, rows)
    report.write()


def status_rows(run: Run, reference: "Reference") -> list[tuple]:
    rows = []
    for status in (ClosureStatus.ACCEPTED, ClosureStatus.REVOKED, ClosureStatus.REJECTED):
        closures = [c for c in run.closures if c.robot_i != c.robot_j and c.status is status]
        for kind, expect in (("one relation", reference.direct), ("chain", reference.chained)):
            compared = [(c, T) for c in closures if (T := expect(c.stamp_i, c.stamp_j)) is not None]
            rows.append((status.value, kind, *summary(len(closures), compared)))
    return rows


def summary(total: int, compared: list[tuple[ClosureRow, FloatArray]]) -> tuple:
    """The table's numbers for ``total`` closures, of which some have an expected T_i_j."""
    error = np.array([se2.between(T_i_j, closure.T_i_j) for closure, T_i_j in compared]).reshape(-1, 3)
    metres, degrees = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    wrong = int(np.sum((metres > WRONG_M) | (degrees > WRONG_DEG)))
    counts = (total, len(error), share(len(error), total), wrong, share(wrong, len(error)))
    if not len(error):
        return *counts, *[np.nan] * 5
    return *counts, np.median(metres), np.quantile(metres, 0.99), metres.max(), np.median(degrees), degrees.max()


def share(part: int, whole: int) -> float:
    return part / whole if whole else np.nan


class Reference:
    """Relations of which both stamps are poses of a run, bridged by the run's trajectory over at most 1 s."""

    def __init__(self, relations: Relations, poses: PoseTable) -> None:
        rows = poses.find(relations.stamps)
        known = np.all(rows >= 0, axis=1)
        T_1_2 = relations.T_1_2[known]
        self._poses = poses
        self._rows = np.concatenate((rows[known], rows[known][:, ::-1]))
        """Rows of the pose table that each relation joins, in both directions, shape (R, 2)."""
        self._T = np.concatenate((T_1_2, se2.inverse(T_1_2)))
        self._links = self._link_table()

    def direct(self, stamp_i: float, stamp_j: float) -> FloatArray | None:
        """T_i_j by the one relation nearest in time; None if there is none within 1 s."""
        i, j = self._poses.find([stamp_i, stamp_j])
        stamps, robots = self._poses.stamps, self._poses.robots
        away_s = np.abs(stamps[self._rows] - stamps[[i, j]])
        near = np.all((away_s <= BRIDGE_S) & (robots[self._rows] == robots[[i, j]]), axis=1)
        if not near.any():
            return None
        best = np.flatnonzero(near)[np.argmin(away_s[near].sum(axis=1))]
        a, b = self._rows[best]
        return se2.compose(se2.compose(self._bridge(i, a), self._T[best]), self._bridge(b, j))

    def chained(self, stamp_i: float, stamp_j: float) -> FloatArray | None:
        """T_i_j by the fewest links; None if more than LINKS are needed."""
        i, j = (int(row) for row in self._poses.find([stamp_i, stamp_j]))
        reached = {row: self._bridge(i, row) for row in self._near(i)}
        goals = frozenset(self._near(j))
        frontier = list(reached)
        for _ in range(LINKS + 1):
            found = [row for row in frontier if row in goals]
            if found:
                return se2.compose(reached[found[0]], self._bridge(found[0], j))
            frontier = self._step(frontier, reached)
        return None

    def _step(self, frontier: list[int], reached: dict[int, FloatArray]) -> list[int]:
        """Rows one link further; ``reached`` learns their poses."""
        new = []
        for row in frontier:
            for other, T_row_other in self._links.get(row, []):
                if other not in reached:
                    reached[other] = se2.compose(reached[row], T_row_other)
                    new.append(other)
        return new

    def _link_table(self) -> dict[int, list[tuple[int, FloatArray]]]:
        links: dict[int, list[tuple[int, FloatArray]]] = {}
        for (a, b), T_a_b in zip(self._rows.tolist(), self._T, strict=True):
            links.setdefault(a, []).append((b, T_a_b))
        for a in list(links):
            links[a] += [(b, self._bridge(a, b)) for b in self._near(a) if b != a]
        return links

    def _near(self, row: int) -> list[int]:
        """Rows that relations name, of the same robot, at most 1 s away."""
        stamps, robots = self._poses.stamps, self._poses.robots
        named = np.unique(self._rows)
        return named[(np.abs(stamps[named] - stamps[row]) <= BRIDGE_S) & (robots[named] == robots[row])].tolist()

    def _bridge(self, a: int, b: int) -> FloatArray:
        T = self._poses.T_map_base
        return se2.between(T[a], T[b])


if __name__ == "__main__":
    main()
