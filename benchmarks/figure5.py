"""The paper's figure 5 for several fleets: the robots' maps, the matched places, the fused map and the building.

    python benchmarks/figure5.py [--fleets FOLDER]

Three robots with LiDAR and camera drive 60 m each in the default simulated building from unknown starts. Each fleet is
mapped by the paper's system (`fcslam map --config paper`) and by the defaults; `fcslam evaluate fleet --figure` draws
both into docs/images. A join is false if it is off by 0.5 m or 10 deg. ATE is that of the worst robot, each map moved
onto the truth as a whole.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import common
import simulated_fleet

SYSTEMS = {"paper": ("--config", "paper"), "default": ()}
"""Options of `fcslam map`, by the name in the pictures' files."""
PICTURES = common.REPOSITORY / "docs" / "images"
COLUMNS = {"seed": "", "system": "", "maps": ".0f", "false joins, of 3": ".0f", "worst ATE, m": ".3f", "F1": ".3f",
           "matches": ".0f", "wrong": ".0f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=simulated_fleet.SEEDS[:3], help="of the fleets")
    parser.add_argument("--fleets", type=Path, help="folder that keeps the recordings [they are deleted]")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rows = [row for seed in chosen.seeds for row in fleet_rows(chosen.fleets or folder, folder, seed)]
    report.table("Fleets", COLUMNS, rows)
    report.write()


def fleet_rows(fleets: Path, folder: Path, seed: int) -> Iterator[tuple]:
    """One fleet by both systems."""
    fleet = common.simulated(fleets / f"default-{seed}", "--robots", simulated_fleet.ROBOTS, "--seed", seed)
    for system, options in SYSTEMS.items():
        run, result = folder / "run", folder / "result.json"
        picture = PICTURES / f"figure5-{seed}-{system}.png"
        common.run_fcslam("map", *sorted(fleet.glob("robot_*")), *options, "--output", run, "--force")
        common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result, "--figure", picture)
        found = simulated_fleet.read(result)
        worst = max(found[f"ate_rmse_robot_{k + 1}"] for k in range(simulated_fleet.ROBOTS))
        matches = [found[f"inter_robot_verified_both_{kind}"] for kind in ("closures", "wrong")]
        yield seed, system, found["maps"], found["false_joins"], worst, found["map_f1"], *matches


if __name__ == "__main__":
    main()
