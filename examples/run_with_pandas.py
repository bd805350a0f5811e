"""Read a run folder with pandas. fcslam itself is not needed for it.

python examples/run_with_pandas.py [RUN_FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

POSE = ["stamp", "x", "y", "z", "qx", "qy", "qz", "qw"]


def main(folder: Path) -> None:
    print(pd.read_csv(folder / "robots.csv").to_string(index=False), "\n")

    closures = pd.read_csv(folder / "closures.csv")
    print(closures.groupby(["status", "reason"]).size().rename("closures").to_string(), "\n")

    metrics = pd.read_json(folder / "metrics.json").set_index("name")
    print("closures between robots:", metrics.value["inter_robot_closures_accepted"], "\n")

    for file in sorted((folder / "trajectories").glob("*.tum")):
        poses = pd.read_csv(file, sep=" ", comment="#", names=POSE)
        steps_m = np.hypot(poses.x.diff(), poses.y.diff())
        speed_m_s = (steps_m / poses.stamp.diff()).median()
        print(f"{file.stem}: {steps_m.sum():.1f} m, median speed {speed_m_s:.2f} m/s")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/two"))
