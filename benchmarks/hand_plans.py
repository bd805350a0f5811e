"""Plans drawn by hand: are maps aligned with them, and does that leave the maps as exact as they are?

    python benchmarks/hand_plans.py
    python benchmarks/hand_plans.py --seeds 1 2

The buildings and drives of `plans.py`. A plan has the walls alone, each as one line of 4, 12, 20 or 30 cm along its
middle. Drawn by hand: each wall is shifted by 2 cm (standard deviation) and wobbles by 6 mm, the whole drawing is bent
by 6 cm in waves of 14 m, and its sides are wrong by 0.4 %. The error is that of both trajectories together (RMSE) after
one rigid alignment, without the plan and with it. "short": scanners of 4 m with 4 cm of noise, whose maps are worse,
and an exact plan.

Passed: all maps aligned with plans drawn by hand, and errors at most 1.1 times as large; the script fails otherwise.
"""

import json
import sys

import common
import cv2
import numpy as np
from plans import CELL_M, SEEDS, fleet_of, in_plan, mapped, true_poses

from fcslam.lab.simulation.floorplan import PieceKind
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulatedFleet, SimulationSettings, simulate_fleet
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.metrics.trajectory import align, position_errors
from fcslam.mission.mission_file import SavedMission
from fcslam.records import FloatArray
from fcslam.runs import Run

WIDTHS_M = (0.04, 0.12, 0.2, 0.3)
MARGIN_M = 1.0
WAVES_M, WAVE_M = 0.06, 14.0
SHIFT_M, WOBBLE_M, STRETCH = 0.02, 0.006, 0.004
MOST_RATIO = 1.1
SHORT = LidarSettings(beams=180, rate_hz=3.0, max_range_m=4.0, range_noise_m=0.04)
COLUMNS = {"plan": "", "seed": "", "lines, m": ".2f", "aligned": "", "bent": "", "without, m": ".4f", "with, m": ".4f",
           "ratio": ".2f", "walls off, m": ".3f", "if bent": ".3f", "residual": ".3f", "if bent ": ".3f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the buildings")
    parser.add_argument("--short", nargs="*", type=int, default=(2, 3), help="of the buildings with short scanners")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    for number, seed in enumerate(chosen.seeds):
        fleet = fleet_of(seed)
        rows.append(row("by hand", seed, fleet, WIDTHS_M[number % len(WIDTHS_M)], by_hand=True))
        print(*rows[-1], flush=True)
    for seed in chosen.short:
        settings = SimulationSettings(robots=2, path_length_m=60.0, camera=None, lidar=SHORT)
        rows.append(row("exact, short", seed, simulate_fleet(settings, seed), 0.12, by_hand=False))
        print(*rows[-1], flush=True)
    report.table("Plans", COLUMNS, rows)
    report.write()
    if any(aligned == "NO" or ratio > MOST_RATIO for kind, _, _, aligned, _, _, _, ratio, *_ in rows):
        sys.exit("a floor is missed")


def row(kind: str, seed: int, fleet: SimulatedFleet, width_m: float, by_hand: bool) -> tuple:
    mission: SavedMission = mapped({robot.name: list(robot.scans()) for robot in fleet.robots})
    plan = drawn(fleet, width_m, np.random.default_rng((seed, 9)), by_hand)
    without, with_plan = in_plan(mission, None), in_plan(mission, plan)
    (report, *_) = json.loads(with_plan.map_files["plan.json"])["maps"]
    before_m, after_m = error_m(without, fleet), error_m(with_plan, fleet)
    off, residuals = report.get("off_m", [float("nan")] * 2), report.get("residuals", [float("nan")] * 2)
    answers = "yes" if report["aligned"] else "NO", "yes" if report.get("bent") else "no"
    return kind, seed, width_m, *answers, before_m, after_m, after_m / before_m, *off, *residuals


def error_m(run: Run, fleet: SimulatedFleet) -> float:
    """The error of the robots in map 0."""
    pairs = [(found, true) for found, true, name in true_poses(run, fleet) if run.trajectories[name].map_index == 0]
    found, true = (np.concatenate(poses) for poses in zip(*pairs, strict=True))
    return float(np.sqrt((position_errors(align(true, found), true, found) ** 2).mean()))


def drawn(fleet: SimulatedFleet, width_m: float, rng: np.random.Generator, by_hand: bool) -> OccupancyMap:
    """The walls as lines."""
    columns, rows = np.ceil((np.array(fleet.plan.size_m) + 2.0 * MARGIN_M) / CELL_M).astype(int)
    cells = np.full((rows, columns), Occupancy.FREE, np.uint8)
    phases, stretch = rng.uniform(0.0, 2.0 * np.pi, 2), rng.normal(0.0, STRETCH, 2)
    for piece in (piece for piece in fleet.plan.pieces if piece.kind is PieceKind.WALL):
        low, high = piece.outline.min(axis=0), piece.outline.max(axis=0)
        along = int(np.argmax(high - low))
        line = np.tile(0.5 * (low + high), (max(2, int(2.0 * (high - low)[along])), 1))
        line[:, along] = np.linspace(low[along], high[along], len(line))
        if by_hand:
            line = bent(line, phases, stretch) + rng.normal(0.0, SHIFT_M, 2) + rng.normal(0.0, WOBBLE_M, line.shape)
        corners = np.round(((line + MARGIN_M) / CELL_M - 0.5) * 16).astype(np.int32)
        cv2.polylines(cells, [corners], False, int(Occupancy.OCCUPIED), round(width_m / CELL_M), shift=4)
    return OccupancyMap(cells, CELL_M, (-MARGIN_M, -MARGIN_M))


def bent(line: FloatArray, phases: FloatArray, stretch: FloatArray) -> FloatArray:
    waves = WAVES_M * np.sin(2.0 * np.pi * line[:, ::-1] / WAVE_M + phases)
    return np.asarray(line * (1.0 + stretch) + waves)


if __name__ == "__main__":
    main()
