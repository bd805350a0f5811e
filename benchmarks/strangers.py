"""Robots in different buildings: nothing may join them.

    FCSLAM_DATA=/path/to/data python benchmarks/strangers.py

Logs of different buildings go into one `fcslam map` as if they were one fleet, so that every pair of buildings is
compared: the raw logs alone, then with those that come corrected. No building is in a fleet twice.
Passed if every log ends in a map of its own and no closure between robots is accepted; the script fails otherwise.
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path

import common
from convert_logs import readable

from fcslam.runs import ClosureRow, Run, open_run

RAW = (
    "slam-benchmark/intel.clf.xz",
    "slam-benchmark/fr079.clf.xz",
    "slam-benchmark/mit-csail.clf.xz",
    "wean-hall/robotdata2.log.gz",
    "ual-campus/ual_2014_05_23.clf.xz",
    "duke-loop5/loop5.log.gz",
    "mines-coreslam/exp1.dat.gz",
)
CORRECTED = tuple(
    f"rbpf-corrected/{name}-corrected.log.gz"
    for name in ("acapulco", "belgioioso", "edmonton", "fhw", "freiburg-101", "orebro", "seattle")
)
GROUPS = {"raw logs": RAW, "all logs": RAW + CORRECTED}
COLUMNS = {"fleet": "", "seed": "", "logs": "", "maps": "", "pairs": "", "pairs with candidates": "", "candidates": "",
           "verified": "", "accepted": "", "revoked": "", "CPU, s": ".1f", "peak, MB": ".0f", "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1), help="of the runs")
    chosen = parser.parse_args()
    folder = common.recordings(*RAW, *CORRECTED)
    report = common.Report(__file__, __doc__, chosen)
    rows, close = [], []
    with tempfile.TemporaryDirectory() as place:
        for number, (group, logs) in enumerate(GROUPS.items()):
            for seed in chosen.seeds:
                out = Path(place) / f"{number}-{seed}"
                paths = [readable(folder / log) for log in logs]
                cost = common.run_fcslam("map", *paths, "--output", out, "--config", f"seed={seed}")
                run = open_run(out)
                rows.append((group, seed, *verdict(run, cost)))
                close += [(group, seed, *row) for row in verified_pairs(run)]
    report.say("Stages add up: what is accepted was verified, what is verified was a candidate.")
    report.table("Different buildings", COLUMNS, rows)
    headings = ("fleet", "seed", "robot", "robot ", "verified", "accepted", "why not more")
    report.table("Pairs that geometry confirmed", dict.fromkeys(headings, ""), close)
    report.write()
    if not all(row[-1] == "yes" for row in rows):
        sys.exit("strangers were joined")


def verdict(run: Run, cost: common.Cost) -> tuple:
    logs = len(run.trajectories)
    maps = len({trajectory.map_index for trajectory in run.trajectories.values()})
    between = closures_between(run)
    touched = len({frozenset((c.robot_i, c.robot_j)) for c in between})
    verified = [c for c in between if was_verified(c)]
    status = Counter(c.status.value for c in between)
    passed = maps == logs and status["accepted"] == 0
    counts = len(between), len(verified), status["accepted"], status["revoked"]
    pairs = logs * (logs - 1) // 2
    return logs, maps, pairs, touched, *counts, cost.cpu_s, cost.peak_mb, "yes" if passed else "NO"


def verified_pairs(run: Run) -> list[tuple]:
    """Pairs of robots with verified closures: how many, how many of them accepted, and the reasons of the others."""
    pairs: dict[tuple[str, ...], list[ClosureRow]] = {}
    for closure in filter(was_verified, closures_between(run)):
        pairs.setdefault(tuple(sorted((closure.robot_i, closure.robot_j))), []).append(closure)
    rows = []
    for names, closures in sorted(pairs.items()):
        accepted = sum(c.status.value == "accepted" for c in closures)
        reasons = sorted({str(c.reason) for c in closures if c.status.value != "accepted"})
        rows.append((*names, len(closures), accepted, "; ".join(reasons)))
    return rows


def closures_between(run: Run) -> list[ClosureRow]:
    return [c for c in run.closures if c.robot_i != c.robot_j]


def was_verified(closure: ClosureRow) -> bool:
    return closure.status.value != "candidate"


if __name__ == "__main__":
    main()
