"""A simulated robot drives through an office building and maps it while it drives.

    python examples/live_robot.py [RUN_FOLDER]

Replace `simulated.scans()` by the scans of your driver, and the script maps your robot.
"""

import sys

import fcslam
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet


def main(folder: str) -> None:
    settings = SimulationSettings(robots=1, building="office", path_length_m=25.0, camera=None)
    simulated = simulate_fleet(settings, seed=1).robots[0]
    with fcslam.Robot("anna", simulated.lasers[0], on_event=lambda event: print(event.text)) as robot:
        for number, scan in enumerate(simulated.scans()):
            pose = robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
            if number % 100 == 0:
                print(f"at ({pose.x:.2f}, {pose.y:.2f}) m, {pose.theta:.2f} rad")
        occupancy = robot.map()
        print(f"the map has {occupancy.cells.shape} cells of {occupancy.resolution_m} m")
        robot.finish()
        robot.save(folder, force=True)
    print(f"written to {folder}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/live")
