"""Fleets drawn on the spot, truth known exactly: accuracy and cost of the real command without any recording.

    python benchmarks/drawn_fleet.py

Three robots with drifting wheels in one drawn building, another for each seed; nothing but the scans tells where they
were relative to each other. Errors are over true relations between different robots.
"""

import tempfile
from pathlib import Path

import common
import numpy as np

from fcslam.evaluation.relations import RelationsQuestion, evaluate_relations
from fcslam.simulation.drawn_fleet import FleetSettings, draw_fleet, write_fleet

COLUMNS = {"seed": "", "robots": "", "maps": ".0f", "scans": ",.0f", "relations used": "", "mean, m": ".4f",
           "max, m": ".3f", "mean, deg": ".3f", "max, deg": ".2f", "CPU, s": ".1f", "wall, s": ".1f",
           "x real time": ".0f", "peak, MB": ".0f", "closures within": ".0f", "between": ".0f", "up, kB": ".0f",
           "down, kB": ".0f"}  # fmt: skip
UP, DOWN = ("hello", "keyscan", "constraint", "place"), ("correction", "acknowledgement")


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=(1, 2, 3), help="of the buildings")
    parser.add_argument("--robots", type=int, default=3, help="how many robots drive")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        rows = [row(Path(place) / str(seed), seed, chosen.robots) for seed in chosen.seeds]
    report.table("Drawn fleets", COLUMNS, rows)
    report.write()


def row(folder: Path, seed: int, robots: int) -> tuple:
    rng = np.random.default_rng(seed)
    logs = write_fleet(draw_fleet(FleetSettings(robots=robots), rng), folder, rng)
    arguments = ("map", *logs, "--output", folder / "run", "--seed", seed, "--force")
    common.run_fcslam(*arguments)  # fills numba's cache
    cost = common.run_fcslam(*arguments)
    question = RelationsQuestion(across_robots=True)
    errors = evaluate_relations(folder / "run", folder / "ground_truth" / "relations", question)
    result = common.metrics(folder / "run")
    accuracy = (errors.translation.mean, errors.translation.maximum, errors.rotation.mean, errors.rotation.maximum)
    costs = (cost.cpu_s, cost.wall_s, result["recorded_time"] / cost.wall_s, cost.peak_mb)
    closures = (result["intra_robot_closures_accepted"], result["inter_robot_closures_accepted"])
    traffic = [sum(result.get(f"{kind}_bytes", 0) for kind in way) / 1e3 for way in (UP, DOWN)]
    head = (seed, robots, result["maps"], result["scans"], f"{errors.used} of {errors.total}")
    return *head, *accuracy, *costs, *closures, *traffic


if __name__ == "__main__":
    main()
