"""How fast fleets are simulated and recorded: the real command, against the time that the robots drive.

    python benchmarks/simulation.py

Three robots, LiDAR 10 Hz with 360 beams, camera 5 Hz of 320 x 240 pixels, each in a thread of its own, 60 m of path
each. Real time is that of the robot that drives longest. It needs a GL library. "If alone" divides it by the CPU time
over the number of cores: what an idle machine would reach if every core were busy all the time.
"""

import os
import tempfile
from pathlib import Path

import common

from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet

COLUMNS = {"building": "", "cameras": "", "floor, m2": ".0f", "rooms": "", "driven, s": ".0f", "scans": ",",
           "images": ",", "wall, s": ".1f", "CPU, s": ".1f", "x real time": ".1f", "if alone": ".1f",
           "peak, MB": ".0f"}  # fmt: skip
INDOORS = [building for building in Building if not building.is_outdoors]
"""Kinds of building that have cameras."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--buildings", nargs="+", type=Building, default=INDOORS, help="kinds of building")
    parser.add_argument("--seed", type=int, default=1, help="of the buildings")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = [row(building, chosen.seed, cameras) for building in chosen.buildings for cameras in (True, False)]
    report.table("Three robots", COLUMNS, rows)
    report.write()


def row(building: Building, seed: int, cameras: bool) -> tuple:
    fleet = simulate_fleet(SimulationSettings(building=building), seed)
    with tempfile.TemporaryDirectory() as place:
        arguments = ["tools", "simulate", "--building", building, "--seed", seed, "--output", Path(place) / "fleet"]
        cost = common.run_fcslam(*arguments, *([] if cameras else ["--no-camera"]))
    driven_s = max(robot.duration_s for robot in fleet.robots)
    scans = sum(len(robot.stamps) for robot in fleet.robots)
    images = sum(len(robot.image_stamps) for robot in fleet.robots) if cameras else 0
    head = (str(building), "yes" if cameras else "no", fleet.plan.floor_m2, len(fleet.plan.rooms))
    speeds = (driven_s / cost.wall_s, driven_s / (cost.cpu_s / (os.cpu_count() or 1)))
    return *head, driven_s, scans, images, cost.wall_s, cost.cpu_s, *speeds, cost.peak_mb


if __name__ == "__main__":
    main()
