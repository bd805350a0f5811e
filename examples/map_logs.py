"""Map two recordings whose robots started at unknown places.

    python examples/map_logs.py [RUN_FOLDER]

Any recording that `fcslam info` accepts can take the place of the sample logs.
"""

import sys
from pathlib import Path

import fcslam

LOGS = Path(__file__).parent / "logs"


def main(folder: str) -> None:
    run = fcslam.map_recordings([LOGS / "anna.clf.xz", LOGS / "ben.clf.xz"], output=folder, force=True)
    for robot, trajectory in run.trajectories.items():
        x, y, theta = trajectory.T_map_base[-1]
        print(f"{robot}: map {trajectory.map_index}, ends at ({x:.2f}, {y:.2f}) m, {theta:.2f} rad")
    accepted = [closure for closure in run.closures if closure.status is fcslam.ClosureStatus.ACCEPTED]
    print(f"{len(accepted)} of {len(run.closures)} closures accepted; look at {folder}/map.png")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/two")
