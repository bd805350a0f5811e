"""Speed and accuracy beside the committed figures, in a few minutes: did a change make either worse?

    FCSLAM_DATA=/path/to/data python benchmarks/quick.py
    FCSLAM_DATA=/path/to/data python benchmarks/quick.py --accept

The second command commits new figures. Errors follow Kuemmerle et al. 2009 (`relations.py`). CPU is counted in units of
a fixed load of the interpreter and numpy that runs before and after each command, so machines of other speed compare.
The least of the repetitions counts; committed figures stand in brackets. Worse means: an error larger by more than
0.5 mm, CPU by more than 25 %, or more maps. The script fails then.
"""

import sys
import tempfile
import time
from pathlib import Path

import common
import numpy as np

from fcslam.lab.evaluation.relations import evaluate_relations

CASES = (*((name, 1) for name in common.SPLITS), ("intel", 3))
TITLE = "Figures"
COLUMNS = {"log": "", "robots": "", "maps": ".0f", "mean error, m": ".4f", "CPU, loads": ".2f", "CPU, s": ".1f"}
LARGER_ERROR_M, LARGER_CPU = 0.0005, 1.25


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--accept", action="store_true", help="commit the figures instead of comparing them")
    parser.add_argument("--repetitions", type=int, default=2)
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    rows = [measured(folder, name, robots, chosen.repetitions) for name, robots in CASES]
    if chosen.accept:
        report.table(TITLE, COLUMNS, rows)
        report.write()
        return
    kept = common.figures(chosen.results / "quick.csv", TITLE)
    committed = {(row["log"], int(row["robots"])): row for row in kept}
    worse = [line for row in rows for line in compared(dict(zip(COLUMNS, row, strict=True)), committed)]
    if worse:
        sys.exit("worse:\n" + "\n".join(worse))


def measured(folder: Path, name: str, robots: int, repetitions: int) -> tuple:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as place:
        arguments = ("map", common.log_path(folder, name), "--output", place, "--split", robots, "--force")
        common.run_fcslam(*arguments)  # fills numba's cache
        costs = []
        for _ in range(repetitions):
            before, cost = load_s(), common.run_fcslam(*arguments)
            costs.append((cost.cpu_s / (0.5 * (before + load_s())), cost.cpu_s))
        errors = evaluate_relations(Path(place), common.relations_path(folder, name))
        return name, robots, common.metrics(Path(place))["maps"], errors.translation.mean, *min(costs)


def load_s() -> float:
    """CPU seconds of a load that resembles the program's: the interpreter, and numpy on small arrays."""
    began = time.process_time()
    rng = np.random.default_rng(0)
    points, total = rng.normal(size=(360, 2)), 0.0
    for k in range(20_000):
        turned = points @ np.array(((np.cos(k), -np.sin(k)), (np.sin(k), np.cos(k))))
        total += float(np.hypot(*turned.T).sum())
        total += sum(j * j for j in range(200))
    return time.process_time() - began


def compared(row: dict, committed: dict) -> list[str]:
    """Print one comparison; returns what got worse."""
    case = f"{row['log']}, robots: {row['robots']}"
    error, cpu = "mean error, m", "CPU, loads"
    before = {name: float(committed[row["log"], row["robots"]][name]) for name in ("maps", error, cpu)}
    errors = f"error {row[error]:.4f} m ({before[error]:.4f})"
    print(f"{case}: {errors}, CPU {row[cpu]:.2f} loads ({before[cpu]:.2f})")
    return [
        *([f"{case}: mean error"] if row[error] > before[error] + LARGER_ERROR_M else []),
        *([f"{case}: CPU"] if row[cpu] > LARGER_CPU * before[cpu] else []),
        *([f"{case}: maps"] if row["maps"] > before["maps"] else []),
    ]


if __name__ == "__main__":
    main()
