"""Robots in different buildings: nothing may join them.

    FCSLAM_DATA=/path/to/data python benchmarks/strangers.py

Logs of different buildings go into one `fcslam map` as if they were one fleet: five alone, then with more buildings.
Passed if every log ends in a map of its own and no closure between robots is accepted; the script fails otherwise.
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path

import common

from fcslam.runs import Run, open_run

RAW = (
    "slam-benchmark/intel.clf.xz",
    "slam-benchmark/fr079.clf.xz",
    "slam-benchmark/mit-csail.clf.xz",
    "wean-hall/robotdata2.log.gz",
    "ual-campus/ual_2014_05_23.clf.xz",
)
CORRECTED = tuple(
    f"rbpf-corrected/{name}-corrected.log.gz" for name in ("acapulco", "edmonton", "fhw", "freiburg-101", "seattle")
)
GROUPS = {"five raw logs": RAW, "ten logs": RAW + CORRECTED}
COLUMNS = {"fleet": "", "seed": "", "logs": "", "maps": "", "pairs": "", "accepted between": "", "verified": "",
           "revoked": "", "rejected": "", "candidates": "", "CPU, s": ".1f", "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1), help="of the runs")
    chosen = parser.parse_args()
    folder = common.recordings(*RAW, *CORRECTED)
    report = common.Report(__file__, __doc__, chosen)
    rows, joined = [], []
    with tempfile.TemporaryDirectory() as place:
        for number, (group, logs) in enumerate(GROUPS.items()):
            for seed in chosen.seeds:
                out = Path(place) / f"{number}-{seed}"
                paths = [folder / log for log in logs]
                cost = common.run_fcslam("map", *paths, "--output", out, "--seed", seed)
                run = open_run(out)
                rows.append((group, seed, *verdict(run, cost.cpu_s)))
                joined += [(group, seed, *pair) for pair in joins(run)]
    report.table("Different buildings", COLUMNS, rows)
    headings = ("fleet", "seed", "robot", "robot ", "accepted")
    report.table("Joined although they should not be", dict.fromkeys(headings, ""), joined)
    report.write()
    if not all(row[-1] == "yes" for row in rows):
        sys.exit("strangers were joined")


def verdict(run: Run, cpu_s: float) -> tuple:
    logs = len(run.trajectories)
    maps = len({trajectory.map_index for trajectory in run.trajectories})
    status = Counter(c.status.value for c in run.closures if c.robot_i != c.robot_j)
    counts = [status[name] for name in ("accepted", "verified", "revoked", "rejected", "candidate")]
    passed = maps == logs and status["accepted"] == 0
    return logs, maps, logs * (logs - 1) // 2, *counts, cpu_s, "yes" if passed else "NO"


def joins(run: Run) -> list[tuple[str, str, int]]:
    """Pairs of robots with accepted closures, and how many."""
    pairs = Counter(
        (c.robot_i, c.robot_j) for c in run.closures if c.robot_i != c.robot_j and c.status.value == "accepted"
    )
    return [(i, j, count) for (i, j), count in sorted(pairs.items())]


if __name__ == "__main__":
    main()
